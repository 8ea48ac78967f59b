"""Injected faults of a simulated arm, in a record that another process can write into."""

from __future__ import annotations

import numpy as np

from hal.base.z1 import N_JOINTS

INJECTED_FAULTS = np.dtype([("error", "u1", (N_JOINTS, 2)), ("link", "u1", (N_JOINTS, 2)), ("silent", "u1")])
"""`MotorError` bits and `MotorLink` of each joint's two motors, and whether the motor board is silent."""
