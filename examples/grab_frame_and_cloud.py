"""Grab one frame of the wrist camera and turn its depth into a cloud in the base frame."""

import numpy as np

from hal.base.transforms import transform_points
from hal.base.z1 import N_ARM
from hal.base.z1_model import ForwardKinematics
from z1_runtime import Robot


def main() -> np.ndarray:
    """Return the cloud (N, 3) in base [m]."""
    with Robot.simulate("cylinder") as robot:
        frame, q = robot.frame(), robot.state().q
        T_base_camera = ForwardKinematics().flange(q[:N_ARM]) @ robot.extrinsics.T_flange_camera
    valid = frame.depth_m > 0.0  # 0 = no measurement
    cloud = (frame.intrinsics.rays() * frame.depth_m[..., None])[valid]
    cloud = transform_points(T_base_camera, cloud)
    print(f"{len(cloud)} points, the highest {cloud[:, 2].max():.3f} m above the table")
    return cloud


if __name__ == "__main__":
    main()
