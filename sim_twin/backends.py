"""The twin's arm, camera and clock behind the contracts of `hal`, in this process.

Lock-step: the clock is a `TwinClock`, physics moves only during a sleep, and an episode is a pure function
of its seed. Real time: the clock is the wall's, and the 500 Hz servo that reads the arm's state drives the physics.
"""

from __future__ import annotations

import math
import os
import sys
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np

from hal.base import z1
from hal.base.clock import Clock, WallClock
from hal.base.errors import HalTimeoutError, NotConnectedError
from hal.base.messages import ArmSetpoint, ArmState, Intrinsics, RgbdFrame
from hal.base.z1 import CONTROL_PERIOD_S
from hal.rig import Rig
from sim_twin.camera import d405
from sim_twin.camera.d405 import View, WristRenderer
from sim_twin.camera.render import make_renderer
from sim_twin.model.scene import SceneConfig
from sim_twin.model.world import World


class TwinClock:
    """Lock-step: sleeping runs the physics, so an episode is a pure function of its seed. For one thread."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._ticks: list[Callable[[], None]] = []
        self._sleeping = False

    def now_s(self) -> float:
        """Return the world's time [s]."""
        return self._world.time_s

    def call_every_tick(self, function: Callable[[], None]) -> None:
        """Call `function` before each control step of a sleep, in the order of registration."""
        self._ticks.append(function)

    def sleep_until(self, t_s: float) -> None:
        """Step the world until `now_s() >= t_s`; every tick function runs before each step.

        Raises:
            RuntimeError: a tick function slept on the clock that is calling it.
        """
        if self._sleeping:
            raise RuntimeError("a function called every tick slept on the twin's clock; it must return at once.")
        self._sleeping = True
        try:
            # Times are whole steps times the period: a nanosecond forgives the caller's own rounding.
            while self._world.time_s < t_s - 1e-6 * CONTROL_PERIOD_S:
                for function in self._ticks:
                    function()
                self._world.step()
        finally:
            self._sleeping = False


_MAX_CATCH_UP_S = 0.020
"""Maximum simulated time that one read catches up; the rest of a delay is dropped: the world slows, never bursts."""


class TwinArm:
    """`hal.base.arm.Arm` of the simulated Z1; moves between threads as the world does (under its lock).

    A setpoint takes effect after the scene's `arm_latency_s`, in whole setpoints; a stop at once.

    Args:
        world: of the arm; by default one of its own.
        clock: a `TwinClock` of that world for lock-step (the default), any other for real time.
        scene: of a world of its own; by default the default one.
    """

    def __init__(
        self, world: World | None = None, clock: Clock | None = None, *, scene: SceneConfig | None = None
    ) -> None:
        self.world = world if world is not None else World(scene or SceneConfig())
        self.clock: Clock = clock if clock is not None else TwinClock(self.world)
        self._lockstep = isinstance(self.clock, TwinClock)
        self._connected = False
        self._latency_periods = round(self.world.config.arm_latency_s / z1.CONTROL_PERIOD_S)
        self._pending: deque[tuple[np.ndarray, np.ndarray]] = deque()
        self._offset_s = 0.0  # clock minus world

    def connect(self) -> None:
        """Start; the arm holds still."""
        self._offset_s = 0.0 if self._lockstep else self.clock.now_s() - self.world.time_s
        self._connected = True

    def disconnect(self) -> None:
        """Leave; the arm holds where it is."""
        if self._connected:
            self.stop()
        self._connected = False

    def read_state(self) -> ArmState:
        """Return the measurement of this moment; in real time the world is first brought up to it.

        Raises:
            NotConnectedError: before `connect()`.
        """
        self._require_connection()
        if not self._lockstep:
            self._catch_up()
        q, dq, tau = self.world.read_arm()
        return ArmState(stamp_s=self.world.time_s + self._offset_s, q=q, dq=dq, tau=tau)

    def send(self, setpoint: ArmSetpoint) -> ArmSetpoint:
        """Set the servos' targets, positions and speeds clamped to the URDF's limits as the vendor's LOWCMD does.

        Raises:
            NotConnectedError: before `connect()`.
        """
        self._require_connection()
        q = np.clip(setpoint.q, z1.Q_MIN, z1.Q_MAX)
        dq = np.clip(setpoint.dq, -z1.DQ_MAX, z1.DQ_MAX)
        self._pending.append((q, dq))
        if len(self._pending) > self._latency_periods:
            self.world.set_command(*self._pending.popleft())
        return ArmSetpoint(q=q, dq=dq)

    def stop(self) -> None:
        """Hold the position measured now."""
        self._pending.clear()
        q, _, _ = self.world.read_arm()
        # MuJoCo's joint limits yield a little under load: a measured position may be just beyond one
        self.world.set_command(np.clip(q, z1.Q_MIN, z1.Q_MAX), np.zeros(z1.N_JOINTS))

    def _catch_up(self) -> None:
        late_s = self.clock.now_s() - self._offset_s - self.world.time_s
        self._offset_s += max(late_s - _MAX_CATCH_UP_S, 0.0)
        # Whole periods only, so that no read runs ahead of the clock.
        due = math.floor(min(late_s, _MAX_CATCH_UP_S) / z1.CONTROL_PERIOD_S + 1e-6)
        for _ in range(due):
            self.world.step()

    def _require_connection(self) -> None:
        if not self._connected:
            raise NotConnectedError("the twin's arm")


class TwinCamera:
    """`hal.base.camera.Camera` of the simulated D405: 640×480 at 30 Hz, with the object's exact mask.

    Drawing happens in a thread of its own, as an OpenGL context belongs to one thread.

    Args:
        world: in view; by default one of its own.
        clock: a `TwinClock` of that world for lock-step (the default), any other for real time.
        renderer: one of `sim_twin.camera.render.RENDERERS`; by default the environment's.
        scene: of a world of its own; by default the default one.
    """

    def __init__(
        self,
        world: World | None = None,
        clock: Clock | None = None,
        renderer: str | None = None,
        *,
        scene: SceneConfig | None = None,
    ) -> None:
        self.world = world if world is not None else World(scene or SceneConfig())
        self.clock: Clock = clock if clock is not None else TwinClock(self.world)
        self._kind = renderer
        self._thread: ThreadPoolExecutor | None = None
        self._renderer: WristRenderer | None = None
        # Images are drawn from a copy of the state, so that the physics can go on meanwhile
        self._snapshot = mujoco.MjData(self.world.model)
        self._first_s = 0.0
        self._sequence = 0
        self._read_arm: Callable[[], ArmState] | None = None

    def follow(self, read_state: Callable[[], ArmState]) -> None:
        """Draw the arm at the joints that `read_state` returns, from the next frame on; the objects stay in place."""
        self._read_arm = read_state

    def connect(self) -> None:
        """Open the renderer and draw once, so that the first frame is as quick as the others.

        Raises:
            CameraError: the renderer is not available.
        """
        if self._thread is not None:
            return
        initializer = None if isinstance(self.clock, TwinClock) else lower_thread_priority
        thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="twin-camera", initializer=initializer)
        try:
            self._renderer = thread.submit(
                make_renderer, self.world.model, d405.INTRINSICS, self._kind, self.world.config.board
            ).result()
            self._thread = thread
            self._expose(sequence=0)
        except BaseException:
            self._thread = thread
            self.disconnect()
            raise
        self._first_s, self._sequence = self.clock.now_s(), 0

    def disconnect(self) -> None:
        """Free the renderer."""
        thread, renderer = self._thread, self._renderer
        self._thread = self._renderer = None
        if thread is not None:
            if renderer is not None:
                thread.submit(renderer.close).result()
            thread.shutdown()

    @property
    def intrinsics(self) -> Intrinsics:
        """Of both images.

        Raises:
            NotConnectedError: before `connect()`.
        """
        self._require_connection()
        return d405.INTRINSICS

    def wait_for_frame(self, timeout_s: float) -> RgbdFrame:
        """Wait for the next of the camera's instants, 30 a second, and return its frame.

        Raises:
            NotConnectedError: before `connect()`.
            HalTimeoutError: that instant is more than `timeout_s` [s] away.
        """
        self._require_connection()
        now_s = self.clock.now_s()
        # The tolerance keeps an instant that rounding puts just after its own step from being exposed twice.
        number = math.floor((now_s - self._first_s) / d405.FRAME_PERIOD_S + 1e-6) + 1
        due_s = self._first_s + number * d405.FRAME_PERIOD_S
        if due_s > now_s + timeout_s:
            self.clock.sleep_until(now_s + timeout_s)
            raise HalTimeoutError(
                f"twin camera: no frame within the timeout ({timeout_s:g} s, allowed 0.04 s or more). Wait longer: "
                "it has 30 frames a second."
            )
        self.clock.sleep_until(due_s)
        stamp_s = self.clock.now_s()
        self._sequence += 1
        view = self._expose(self._sequence)
        return RgbdFrame(
            colour=view.colour,
            depth_m=view.z_m,
            intrinsics=d405.INTRINSICS,
            stamp_s=stamp_s,
            sequence=self._sequence,
            serial=self.world.config.camera_serial(),
            ground_truth_mask=view.mask,
        )

    def _expose(self, sequence: int) -> View:
        """Return the sensor's image of the present scene, computed in the camera's own thread."""
        thread, renderer = self._thread, self._renderer
        if thread is None or renderer is None:
            raise NotConnectedError("the twin's camera")
        return thread.submit(self._draw, renderer, sequence).result()

    def _draw(self, renderer: WristRenderer, sequence: int) -> View:
        if self._read_arm is not None:
            self.world.place_arm(self._read_arm().q)
        view, config = renderer.render(self.world.snapshot(self._snapshot)), self.world.config
        if not config.noise:
            return replace(view, z_m=d405.round_depth(view.z_m))
        colour = d405.measure_colour(view.colour, config.seed, sequence)
        return replace(view, colour=colour, z_m=d405.measure_depth(view.z_m, config.seed, sequence))

    def _require_connection(self) -> None:
        if self._thread is None:
            raise NotConnectedError("the twin's camera")


def lower_thread_priority() -> None:
    """Lower this thread's priority: software GL and the noise must not keep the servo's thread from its core."""
    if sys.platform == "linux":  # where a priority belongs to a thread
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 10)


def make_rig(scene: SceneConfig | None = None, lockstep: bool = False, **fields: Any) -> Rig:
    """Return arm, camera and clock of one new world, not yet connected.

    Args:
        scene: objects on the table; None builds it from `fields`.
        lockstep: True for the twin's own clock, False for the wall's.
        **fields: of a `SceneConfig`, for callers that do not import the twin.
    """
    world = World(scene if scene is not None else SceneConfig(**fields))
    twin_clock = TwinClock(world)
    clock: Clock = twin_clock if lockstep else WallClock()
    return Rig(
        arm=TwinArm(world, clock),
        camera=TwinCamera(world, clock),
        clock=clock,
        call_every_tick=twin_clock.call_every_tick if lockstep else None,
        world=world,
    )
