"""Grippers that diffusion weights exist for, by the name in the weights' recipe."""

from __future__ import annotations

from types import MappingProxyType

MAX_WIDTHS_M = MappingProxyType({"agnostic": 0.136, "z1": 0.080})
"""Widest object per gripper [m]: the opening of a Robotiq 2F-140 (its datasheet), the Z1's in the training data."""
