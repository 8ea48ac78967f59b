"""Recorder of a second with filters, of a point cloud, and replay of the recording."""

import sys

import numpy as np
import pyrealsense2 as rs

file, cloud = sys.argv[1:3]
queue = rs.frame_queue(50, keep_frames=True)
config = rs.config()
config.enable_stream(rs.stream.depth, 424, 240, rs.format.z16, 30)
config.enable_stream(rs.stream.color, 424, 240, rs.format.rgb8, 30)
config.enable_record_to_file(file)
pipeline = rs.pipeline()
pipeline.start(config, queue)
filters = [rs.decimation_filter(), rs.threshold_filter(0.1, 1.0), rs.disparity_transform(True), rs.spatial_filter()]
filters += [rs.temporal_filter(), rs.disparity_transform(False), rs.hole_filling_filter()]
for _ in range(20):
    frames = queue.wait_for_frame(5000).as_frameset()
    depth = frames.get_depth_frame()
    for stage in filters:
        depth = stage.process(depth)
print("filtered", np.asanyarray(depth.get_data()).shape)
heat = rs.colorizer().colorize(frames.get_depth_frame())
print("colorized", np.asanyarray(heat.get_data()).shape)
points = rs.pointcloud()
points.map_to(frames.get_color_frame())
mesh = points.calculate(frames.get_depth_frame())
vertices = np.asanyarray(mesh.get_vertices()).view(np.float32).reshape(-1, 3)
print("vertices", len(vertices), f"{np.median(vertices[vertices[:, 2] > 0, 2]):.2f}")
mesh.export_to_ply(cloud, frames.get_color_frame())
pipeline.stop()

config = rs.config()
rs.config.enable_device_from_file(config, file, repeat_playback=False)
profile = pipeline.start(config)
playback = profile.get_device().as_playback()
playback.set_real_time(False)
print("played from", profile.get_device().get_info(rs.camera_info.name))
count = 0
while True:
    success, frames = pipeline.try_wait_for_frames(1000)
    if not success:
        break
    count += 1
print("played", count >= 19)
pipeline.stop()
