"""Printer of the depth at the image's centre, ten times, and of a coarse depth image in letters."""

import pyrealsense2 as rs

pipeline = rs.pipeline()
config = rs.config()
config.enable_stream(rs.stream.depth, 640, 480, rs.format.z16, 30)
pipeline.start(config)
try:
    for _ in range(10):
        frames = pipeline.wait_for_frames()
        depth = frames.get_depth_frame()
        if not depth:
            continue
        width, height = depth.get_width(), depth.get_height()
        print(f"distance {depth.get_distance(width // 2, height // 2):.3f}")
    for row in range(20, height, 40):
        near = [0.0 < depth.get_distance(column, row) < 0.5 for column in range(10, width, 20)]
        print("".join("#" if hit else "." for hit in near))
finally:
    pipeline.stop()
