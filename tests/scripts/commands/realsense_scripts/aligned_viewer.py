"""Viewer of depth aligned to colour, without the background, until a key is pressed; for any D400."""

import argparse

import cv2
import numpy as np
import pyrealsense2 as rs

parser = argparse.ArgumentParser()
parser.add_argument("--clip", type=float, default=0.6, help="background begins here, in metres")
args = parser.parse_args()

context = rs.context()
if len(context.query_devices()) == 0:
    raise SystemExit("no device connected")
for device in context.devices:
    print(device.get_info(rs.camera_info.name), device.get_info(rs.camera_info.serial_number))
    print("usb", device.get_info(rs.camera_info.usb_type_descriptor))

pipeline, config = rs.pipeline(), rs.config()
wrapper = rs.pipeline_wrapper(pipeline)
device = config.resolve(wrapper).get_device()
print("product line", device.get_info(rs.camera_info.product_line))
config.enable_stream(rs.stream.depth, 640, 480, rs.format.z16, 30)
config.enable_stream(rs.stream.color, 640, 480, rs.format.bgr8, 30)

profile = pipeline.start(config)
depth_sensor = profile.get_device().first_depth_sensor()
scale = depth_sensor.get_depth_scale()
print(f"depth scale {scale:.6f}")
for option in (rs.option.laser_power, rs.option.emitter_enabled):
    if depth_sensor.supports(option):
        depth_sensor.set_option(option, 0)
depth_sensor.set_option(rs.option.enable_auto_exposure, 1)

align = rs.align(rs.stream.color)
try:
    while True:
        aligned = align.process(pipeline.wait_for_frames())
        depth_frame, color_frame = aligned.get_depth_frame(), aligned.get_color_frame()
        if not depth_frame or not color_frame:
            continue
        depth = np.asanyarray(depth_frame.get_data())
        color = np.asanyarray(color_frame.get_data())
        background = np.dstack([depth, depth, depth])
        removed = np.where((background > args.clip / scale) | (background <= 0), 153, color).astype(np.uint8)
        heat = cv2.applyColorMap(cv2.convertScaleAbs(depth, alpha=0.03), cv2.COLORMAP_JET)
        cv2.namedWindow("Aligned", cv2.WINDOW_NORMAL)
        cv2.imshow("Aligned", np.hstack((removed, heat)))
        key = cv2.waitKey(1)
        if key & 0xFF == ord("q") or key == 27:
            cv2.destroyAllWindows()
            break
finally:
    pipeline.stop()

intrinsics = color_frame.profile.as_video_stream_profile().intrinsics
v, u = np.argwhere(depth > 0)[0]
point = rs.rs2_deproject_pixel_to_point(intrinsics, [int(u), int(v)], float(depth[v, u] * scale))
back = rs.rs2_project_point_to_pixel(intrinsics, point)
print("there and back", round(back[0]) == u, round(back[1]) == v)
