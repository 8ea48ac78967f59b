"""Options of the twin's scene on the command line; importing them does not load the twin."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sim_twin.model.charuco_board import BoardSpec
    from sim_twin.model.scene import SceneConfig


@dataclass(frozen=True, kw_only=True)
class MountErrorOptions:
    """Error of the twin's camera mount, which only a calibration can measure."""

    mount_error_m: float = 0.0
    """Twin: offset of the camera from its nominal pose on the flange [m]."""
    mount_error_deg: float = 0.0
    """Twin: rotation of the camera from its nominal pose [°]."""
    mount_seed: int = 0
    """Twin: seed of the direction of both."""


@dataclass(frozen=True, kw_only=True)
class SceneOptions(MountErrorOptions):
    """The object on the twin's table, and the twin's camera."""

    object: str = "bottle"
    """Twin: bottle, box, cylinder, or another of `sim_twin.model.objects`."""
    distance_m: float = 0.48
    """Twin: distance of the object in front of the base [m]."""
    lateral_m: float = 0.0
    """Twin: offset of the object to the left [m]."""
    pitch_deg: float = 0.0
    """Twin: lean of the object about the base's y axis [°]; a break-away fixture holds a leaning one."""
    seed: int = 0
    """Twin: seed of the camera's noise, and of the grasp generator."""

    def to_scene(self, board: BoardSpec | None = None) -> SceneConfig:
        """Return the scene, with `board` in place of the object if it is given.

        Raises:
            InvalidValueError: an option is out of its range.
        """
        from sim_twin.model.scene import SceneConfig  # `./z1 hal --real` must not load the twin

        return SceneConfig(**asdict(self), board=board)
