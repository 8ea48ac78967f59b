"""Rig: the devices of one robot, by name from the registry of backends, and connected under a servo or over the bus."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from hal.base.clock import Clock, WallClock
from hal.base.errors import InvalidValueError, UnknownBackendError
from hal.base.messages import ArmState

if TYPE_CHECKING:
    from hal.base.arm import Arm, ServoedArm
    from hal.base.camera import Camera
    from hal.bus.session import BusConfig
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


@dataclass(frozen=True, slots=True, kw_only=True)
class Devices:
    """A servoed arm, a camera, and the clock of both, all connected."""

    arm: ServoedArm
    camera: Camera
    clock: Clock
    real_time: bool = True
    """False in lock-step, where time moves only while a caller sleeps on the clock."""
    world: Any = None
    """The simulated world of a rig in this process, for evaluation only."""


@contextmanager
def connect_rig(rig: Rig, *, camera: bool = True) -> Iterator[Devices]:
    """Yield the devices of `rig` under a servo with the default workspace guard; its lease is free.

    In lock-step the same calls give the same bytes; otherwise a thread of this process ticks the servo.

    Args:
        rig: not connected yet.
        camera: False leaves its connection to the caller, as a connected one holds a renderer.
    """
    from hal.servo.guard import Guard
    from hal.servo.servo import Servo

    servo = Servo(rig.arm, rig.clock, guard=Guard())
    with ExitStack() as stack:
        stack.callback(rig.camera.disconnect)
        if camera:  # first: a missing one leaves the arm as it is
            rig.camera.connect()
        servo.connect()
        stack.callback(servo.disconnect)
        if rig.follow_arm is not None:
            rig.follow_arm(servo.read_state)
        if rig.call_every_tick is not None:
            rig.call_every_tick(servo.tick)
        else:
            from hal.servo.servo_thread import ServoThread

            stack.enter_context(ServoThread(servo, rig.clock))
        yield Devices(
            arm=servo,
            camera=rig.camera,
            clock=rig.clock,
            real_time=rig.call_every_tick is None,
            world=rig.world,
        )


@contextmanager
def connect_remote(bus: BusConfig, owner: str, *, camera: bool = True) -> Iterator[Devices]:
    """Yield the devices of the HAL process at `bus`; its lease is free until `owner` claims it.

    Args:
        bus: address of the HAL process.
        owner: name of this client.
        camera: False for the arm alone, as of a HAL process without a camera.

    Raises:
        HalTimeoutError: no HAL process answers.
    """
    from hal.bus.client import RemoteArm
    from hal.bus.remote_camera import RemoteCamera

    clock = WallClock()
    # Disconnecting releases the lease, also after the HAL process has ended.
    with RemoteArm(bus, owner, clock) as arm:
        if not camera:
            yield Devices(arm=arm, camera=CAMERAS.make("none"), clock=clock)
            return
        with RemoteCamera(bus, clock) as remote_camera:
            yield Devices(arm=arm, camera=remote_camera, clock=clock)
