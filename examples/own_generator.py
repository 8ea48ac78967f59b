"""Pick with a grasp generator of your own: any object with `sample(points, n, seed)`."""

import numpy as np

from models.samplers.antipodal import AntipodalSampler
from models.types import GraspSet
from z1_runtime import Robot


class BestAntipodal:
    """Antipodal grasps, of three times as many the ones with the highest scores."""

    def sample(self, points: np.ndarray, n: int, seed: int) -> GraspSet:
        """Return `n` grasps in the frame of `points` (M, 3) [m]."""
        grasps = AntipodalSampler().sample(points, 3 * n, seed)
        return grasps[np.argsort(-grasps.scores, kind="stable")[:n]]


def main() -> bool:
    """Return whether the jaws hold the object."""
    with Robot.simulate("box", generator=BestAntipodal()) as robot:
        result = robot.pick()
    print(f"held: {result.held}, of {len(result.selection.grasps)} candidates")
    return result.held


if __name__ == "__main__":
    raise SystemExit(0 if main() else 1)
