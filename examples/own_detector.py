"""Pick with a detector of your own: any object with `classes`, `min_confidence` and `detect(frame, T_base_camera)`."""

import numpy as np

from hal.base.messages import RgbdFrame
from models.types import Detection
from z1_runtime import Robot


class NearestObject:
    """The pixels nearer than the table in the middle of the image, as one object."""

    classes = ()  # knows no classes
    min_confidence = 0.0

    def detect(self, frame: RgbdFrame, T_base_camera: np.ndarray) -> list[Detection]:
        """Return one detection, or none."""
        height_m = (frame.intrinsics.rays() * frame.depth_m[..., None]) @ T_base_camera[2, :3] + T_base_camera[2, 3]
        mask = (frame.depth_m > 0.1) & (frame.depth_m < 0.5) & (height_m > 0.01)
        rows, columns = np.nonzero(mask)
        if not len(rows):
            return []
        box = (int(columns.min()), int(rows.min()), int(columns.max()) + 1, int(rows.max()) + 1)
        return [Detection(label="object", confidence=1.0, box_px=box, mask=mask)]


if __name__ == "__main__":
    with Robot.simulate("box", detector=NearestObject()) as robot:
        print(f"held: {robot.pick().held}")
