"""Ground truth of the twin's scene over Zenoh, for evaluation only."""

from __future__ import annotations

import atexit
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Self

import msgpack
import numpy as np

from hal.base.clock import WallClock
from hal.base.errors import HalTimeoutError
from hal.bus import keys
from hal.bus.authentication import Request
from hal.bus.link import BusLink, link_secret
from hal.bus.service import Service
from hal.bus.session import BusConfig, open_session

if TYPE_CHECKING:
    from sim_twin.model.world import SceneView

_KEY = f"{keys.EVALUATION}/ground_truth"
_POSES = ("T_base_object", "T_flange_camera", "T_base_board")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GroundTruth:
    """Exact state of the scene."""

    object: str
    """Its name."""
    T_base_object: np.ndarray
    """(4, 4) its pose."""
    lifted_m: float
    """How much higher its lowest point is than at the start [m]."""
    T_flange_camera: np.ndarray
    """(4, 4) the camera's true pose."""
    T_base_board: np.ndarray | None
    """(4, 4) where the calibration board is (`sim_twin.model.charuco_board.BoardSpec`); None without one."""
    qpos: np.ndarray
    """(14,) MuJoCo's positions: joints [rad], then the object's position [m] and quaternion (wxyz)."""


def read_ground_truth(world: SceneView) -> GroundTruth:
    """Return the ground truth of `world` at this moment."""
    return GroundTruth(
        object=world.config.object,
        T_base_object=world.T_base_object(),
        lifted_m=world.lifted_m(),
        T_flange_camera=world.config.T_flange_camera(),
        T_base_board=None if world.config.board is None else world.config.board.T_base_board(),
        qpos=world.poses()[1],
    )


class GroundTruthServer:
    """Server of a world's ground truth in its HAL process, whose link must be open.

    Rendering is left to the client: it would take the interpreter from the servo here.
    """

    def __init__(self, config: BusConfig, world: SceneView) -> None:
        self._world = world
        self._session = open_session(config, listen=False)
        secret = link_secret(config)
        self._service = Service(self._session, _KEY, self._answer, on_failure=lambda: None, secret=secret)
        atexit.register(self.close)  # a program that ends carelessly leaves no thread inside Zenoh

    def close(self) -> None:
        """Stop serving."""
        atexit.unregister(self.close)
        self._service.close()
        self._session.close()

    def _answer(self, request: Request) -> bytes:
        ground_truth = read_ground_truth(self._world)
        content = {
            "object": ground_truth.object,
            "lifted_m": ground_truth.lifted_m,
            "qpos": ground_truth.qpos.tolist(),
            **{
                name: None if (pose := getattr(ground_truth, name)) is None else pose.ravel().tolist()
                for name in _POSES
            },
        }
        return msgpack.packb(content)  # pyright: ignore[reportReturnType] (its stub is wrong)


class GroundTruthClient:
    """Client of a twin's HAL process.

    Raises:
        HalTimeoutError: no HAL process answers.
    """

    def __init__(self, config: BusConfig) -> None:
        self._link = BusLink(replace(config, request_timeout_s=2.0), WallClock(), "the twin's ground truth")

    def read(self) -> GroundTruth:
        """Return the ground truth at this moment.

        Raises:
            HalTimeoutError: no twin answers, for instance because the HAL drives a real arm.
        """
        try:
            content = msgpack.unpackb(self._link.request(_KEY))
        except HalTimeoutError as error:
            raise HalTimeoutError(
                f"ground truth: no simulated HAL answers ({error}). Start one with `./z1 hal --hal sim`.",
                code="no_twin",
            ) from error
        for name in _POSES:
            content[name] = None if content[name] is None else np.array(content[name]).reshape(4, 4)
        return GroundTruth(qpos=np.array(content.pop("qpos")), **content)

    def close(self) -> None:
        """Hang up."""
        self._link.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
