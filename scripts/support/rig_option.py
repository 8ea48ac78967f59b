"""The one word that chooses the hardware: `--sim`, `--wire-sim`, `--mock`, `--real`, or `--hal NAME`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

_ONE_OF_THEM = tyro.conf.create_mutex_group(required=False, title="hardware")
_Word = Annotated[bool, tyro.conf.FlagCreatePairsOff, _ONE_OF_THEM]

DEFAULT = "sim"


@dataclass(frozen=True, kw_only=True)
class RigOption:
    """Which rig; at most one of these."""

    hal: Annotated[str, _ONE_OF_THEM] = DEFAULT
    """Any rig by its name."""
    sim: _Word = False
    """The digital twin; so it is without any of these."""
    wire_sim: _Word = False
    """The twin behind the real arm's and the real camera's drivers."""
    mock: _Word = False
    """An arm without physics and a recorded camera, for trying clients."""
    real: _Word = False
    """The Z1 and the D405 of this machine."""

    @property
    def name(self) -> str:
        """The rig's name, as in `hal.rig.RIGS`."""
        chosen = [word for word in ("sim", "wire_sim", "mock", "real") if getattr(self, word)]
        return chosen[0].replace("_", "-") if chosen else self.hal
