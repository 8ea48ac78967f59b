"""Rig: one set of connected devices, an arm, a camera, and their clock; and the registry of backends."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from hal.base.arm import Arm
from hal.base.camera import Camera
from hal.base.clock import Clock
from hal.base.errors import InvalidValueError, UnknownBackendError
from hal.base.messages import ArmState

if TYPE_CHECKING:
    from hal.parking import Parking


T = TypeVar("T")


class Registry(Generic[T]):
    """Names of one kind of backend."""

    def __init__(self, kind: str, entries: Mapping[str, str]) -> None:
        self._kind = kind
        self._entries = dict(entries)

    def register(self, name: str, target: str) -> None:
        """Add `name` as `"module:attribute"`.

        Raises:
            InvalidValueError: the name is taken (`name_taken`).
        """
        if name in self._entries:
            raise InvalidValueError(
                f"registry: {self._kind} backend {name!r} is registered already, as {self._entries[name]}. Choose "
                f"another name.",
                code="name_taken",
            )
        self._entries[name] = target

    def names(self) -> list[str]:
        """Return all names, sorted."""
        return sorted(self._entries)

    def make(self, name: str, **options: Any) -> T:
        """Import the backend and call it with `options`.

        Raises:
            UnknownBackendError: no backend has that name; the message lists the known ones.
        """
        if name not in self._entries:
            raise UnknownBackendError(self._kind, name, self._entries)
        module, attribute = self._entries[name].split(":")
        return getattr(import_module(module), attribute)(**options)


ARMS: Registry[Arm] = Registry(
    "arm",
    {
        "mock": "hal.backends.mock_arm:MockArm",
        "sim": "sim_twin.backends:TwinArm",
        "z1": "hal.backends.z1.arm:Z1Arm",
    },
)
CAMERAS: Registry[Camera] = Registry(
    "camera",
    {
        "d405": "hal.backends.d405.camera:D405Camera",
        "none": "hal.backends.no_camera:NoCamera",
        "replay": "hal.backends.replay_camera:ReplayCamera",
        "sim": "sim_twin.backends:TwinCamera",
    },
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Rig:
    """One robot's devices, not yet connected."""

    arm: Arm
    camera: Camera
    clock: Clock
    call_every_tick: Callable[[Callable[[], None]], None] | None = None
    """In lock-step: registers a callback that the clock calls every control period while a thread sleeps on it. None on
    the wall clock, where `hal.servo.servo_thread.ServoThread` ticks."""
    find_arm: Callable[[], None] | None = None
    """Looks for the arm and changes nothing at it; raises what its `connect` would. None where it is always there."""
    give_back: Callable[[], None] | None = None
    """Returns the connected arm to the state in which it was found, after a start that failed; None = it holds."""
    follow_arm: Callable[[Callable[[], ArmState]], None] | None = None
    """Gives a camera that renders the arm the source of its measurements; None = it has its own."""
    park: Parking | None = None
    """Parking of the arm at the end of a HAL process; None = the arm holds its position."""
    world: Any = None
    """The simulated world behind the devices, for evaluation only; None on a real robot."""


RIGS: Registry[Rig] = Registry(
    "rig",
    {
        "mock": "hal.backends.mock_arm:make_rig",
        "real": "hal.backends.real_rig:make_rig",
        "sim": "sim_twin.backends:make_rig",
        "wire-sim": "sim_twin.drop_in.rig:make_wire_sim_rig",
    },
)
