"""Option that selects the hardware: `--sim`, `--wire-sim`, `--mock`, `--real`, or `--hal NAME`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

_EXCLUSIVE = tyro.conf.create_mutex_group(required=False, title="hardware")
_Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff, _EXCLUSIVE]  # without `--no-sim`, which would select nothing

DEFAULT = "sim"


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

    @property
    def name(self) -> str:
        """The rig's name, as in `hal.rig.RIGS`."""
        # The mutex group allows one of them; field names have no hyphen
        selected = [name for name in ("sim", "wire_sim", "mock", "real") if getattr(self, name)]
        return selected[0].replace("_", "-") if selected else self.hal
