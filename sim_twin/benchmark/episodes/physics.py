"""Deviations of a world from the runtime's model, sampled once per episode."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

SPREAD = 0.3
"""Maximum relative deviation of friction and mass."""
MOUNT_ERROR_M, MOUNT_ERROR_DEG = 0.003, 1.0
"""Offset and turn of the camera from the runtime's extrinsics, in any direction."""
MAX_ARM_LATENCY_S = 0.020
"""Maximum latency of the arm: its controller's cycle, the network and the motors' own loops."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Physics:
    """One world's deviations, named as in `sim_twin.model.scene.SceneConfig`; by default none."""

    friction_factor: float = 1.0
    mass_factor: float = 1.0
    mount_error_m: float = 0.0
    mount_error_deg: float = 0.0
    mount_seed: int = 0
    arm_latency_s: float = 0.0

    @classmethod
    def sample(cls, seed: int) -> Physics:
        """Return the deviations that belong to `seed`."""
        rng = np.random.default_rng([seed, 0xF0])  # a stream of its own: the camera's noise has the bare seed
        friction, mass = rng.uniform(1.0 - SPREAD, 1.0 + SPREAD, 2)
        return cls(
            friction_factor=float(friction),
            mass_factor=float(mass),
            mount_error_m=MOUNT_ERROR_M,
            mount_error_deg=MOUNT_ERROR_DEG,
            mount_seed=int(rng.integers(2**32)),
            arm_latency_s=float(rng.uniform(0.0, MAX_ARM_LATENCY_S)),
        )
