"""Options that select the hardware: `--sim`, `--wire-sim`, `--mock`, `--real`, `--hal NAME`, and parts of a rig."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from hal.base.errors import InvalidValueError

_EXCLUSIVE = tyro.conf.create_mutex_group(required=False, title="hardware")
_Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff, _EXCLUSIVE]  # without `--no-sim`, which would select nothing

DEFAULT = "sim"
NO_CAMERA = "none"
_PARTS = {"sim": ("sim", "sim"), "mock": ("mock", "replay"), "real": ("z1", "d405")}
"""Rig to its arm and its camera, as in `hal.rig`; the others have no parts to exchange."""


@dataclass(frozen=True, kw_only=True)
class RigOption:
    """Selection of the rig; at most one of these."""

    hal: Annotated[str, _EXCLUSIVE] = DEFAULT
    """A rig by its name."""
    sim: _Flag = False
    """The digital twin, the default."""
    wire_sim: _Flag = False
    """The twin behind the drivers of the real arm and the real camera."""
    mock: _Flag = False
    """An arm without physics and a recorded camera, for testing clients."""
    real: _Flag = False
    """The Z1 and the D405 of this machine."""
    arm: str | None = None
    """Another arm than the rig's, by its name: `z1`, `sim` or `mock`."""
    camera: str | None = None
    """Another camera than the rig's, by its name: `d405`, `sim` (it renders the arm of the rig where that is) or
    `replay`."""
    no_camera: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Run the arm alone."""

    def __post_init__(self) -> None:
        if self.camera is not None and self.no_camera:
            raise InvalidValueError(
                f"hal: --camera {self.camera} and --no-camera exclude each other. Give one of them.",
                code="two_cameras",
            )

    @property
    def parts(self) -> tuple[str, str] | None:
        """Names of arm and camera, as in `hal.rig.ARMS` and `CAMERAS`; None for a whole rig.

        Raises:
            InvalidValueError: the rig has no such parts (`no_parts`).
        """
        if self.arm is None and self.camera is None and not (self.no_camera and self.name in _PARTS):
            return None
        if self.name not in _PARTS:
            raise InvalidValueError(
                f"hal: arm and camera of this rig cannot be exchanged ({self.name}, allowed {', '.join(_PARTS)}). "
                "Leave out --arm and --camera.",
                code="no_parts",
            )
        arm, camera = _PARTS[self.name]
        parts = (self.arm or arm, NO_CAMERA if self.no_camera else self.camera or camera)
        return None if parts == (arm, camera) else parts

    @property
    def name(self) -> str:
        """The rig's name, as in `hal.rig.RIGS`."""
        # The mutex group allows one of them; field names have no hyphen
        selected = [name for name in ("sim", "wire_sim", "mock", "real") if getattr(self, name)]
        return selected[0].replace("_", "-") if selected else self.hal
