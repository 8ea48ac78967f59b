"""Perception, grasp selection, planning and tasks; `Robot` is the public API."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from z1_runtime.robot import Robot

__all__ = ["Robot"]


def __getattr__(name: str) -> Any:
    if name == "Robot":  # lazily: every module of the package imports this file first
        from z1_runtime.robot import Robot

        return Robot
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
