"""Rank given grasps with the oriented bounding box of a cloud, without any robot."""

import numpy as np

from models.obb.mvbb import RankedGrasps, fit_obb, rank_grasps
from models.samplers.antipodal import AntipodalSampler


def main() -> RankedGrasps:
    """Return the grasps that approach one of the two box faces nearest to the camera, best first."""
    rng = np.random.default_rng(0)
    points = rng.uniform((-0.03, -0.08, 0.37), (0.03, 0.08, 0.43), (4000, 3))  # camera frame, z forward [m]
    grasps = AntipodalSampler().sample(points, 200, seed=0)  # or your own `models.types.GraspSet`
    box = fit_obb(points, "pca")
    ranked = rank_grasps(grasps, box, k=2, alpha=0.85)
    print(f"box {(2e3 * box.half_extents_m).round()} mm; {len(ranked)} of {len(grasps)} grasps pass")
    return ranked


if __name__ == "__main__":
    main()
