"""The HAL process ends when it is told to; what two processes do to each other is in `bus/test_two_processes.py`."""

from __future__ import annotations

import socket
import subprocess
import sys
from contextlib import ExitStack
from dataclasses import replace
from threading import Event

import numpy as np
import pytest

from hal.backends.mock_arm import MockArm, make_rig
from hal.base.clock import WallClock
from hal.base.errors import CameraError, HalError, HalTimeoutError, NotConnectedError
from hal.bus import keys
from hal.bus.client import RemoteArm
from hal.bus.service import Listener
from hal.bus.session import BusConfig, open_session
from hal.parking import Parking
from hal.process import serve

SIGNALLED = """
import signal, threading
from hal.process import stop_on_signals
ended = threading.Event()
stop_on_signals(ended)
with ended._cond:  # as the main thread does for a moment at each look at the event
    signal.raise_signal(signal.SIGTERM)
print(ended.wait(30), flush=True)
"""

TWICE = """
import signal, threading
from hal.process import stop_on_signals
first, second = threading.Event(), threading.Event()
stop_on_signals(first, second)
signal.raise_signal(signal.SIGINT)
print(first.wait(30), second.is_set(), flush=True)
signal.raise_signal(signal.SIGINT)
print(first.wait(30), second.wait(30), flush=True)
"""


def test_a_signal_in_the_moment_the_event_is_looked_at_ends_the_process_and_does_not_hang_it() -> None:
    done = subprocess.run([sys.executable, "-c", SIGNALLED], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout == "True\n"


def free_config() -> BusConfig:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return BusConfig(port=probe.getsockname()[1])


class StoppableArm(MockArm):
    """Notes that it was stopped, and breaks in a way nobody expected once it is told to."""

    broken = False
    stops = 0

    def read_state(self):
        if self.broken:
            raise ZeroDivisionError("a bug in the driver")
        return super().read_state()

    def stop(self) -> None:
        self.stops += 1
        super().stop()


def test_a_servo_that_dies_ends_the_process_with_its_error_and_the_arm_stopped() -> None:
    arm = StoppableArm(WallClock())

    def break_it() -> None:
        arm.broken = True

    with pytest.raises(ZeroDivisionError, match="a bug in the driver"):
        serve(replace(make_rig(), arm=arm), free_config(), Event(), on_ready=break_it)
    assert arm.stops == 1
    arm.broken = False
    with pytest.raises(NotConnectedError):
        arm.read_state()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_thread_of_the_server_that_dies_ends_the_process(monkeypatch: pytest.MonkeyPatch) -> None:
    rig, config = make_rig(), free_config()
    monkeypatch.setattr(rig.camera, "wait_for_frame", lambda _: 1 / 0)
    with ExitStack() as undo:

        def listen() -> None:
            session = undo.enter_context(open_session(config, listen=False))
            undo.callback(Listener(session, keys.FRAME, lambda _: None).close)

        with pytest.raises(HalError, match="server died; its traceback is above"):
            serve(rig, config, Event(), on_ready=listen)


@pytest.mark.parametrize("independent", [True, False])
def test_a_camera_that_cannot_be_had_leaves_no_arm_connected(
    monkeypatch: pytest.MonkeyPatch, independent: bool
) -> None:
    rig = replace(make_rig(), independent=independent)

    def fail() -> None:
        raise CameraError("no camera is plugged in")

    monkeypatch.setattr(rig.camera, "connect", fail)
    with pytest.raises(CameraError):
        serve(rig, free_config(), Event())
    with pytest.raises(NotConnectedError):
        rig.arm.read_state()


def test_without_arm_and_camera_both_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = replace(make_rig(), independent=True)

    def no_camera() -> None:
        raise HalTimeoutError("no camera at USB.")

    def no_arm() -> None:
        raise HalTimeoutError("no arm at 192.0.2.1.")

    monkeypatch.setattr(rig.camera, "connect", no_camera)
    monkeypatch.setattr(rig.arm, "connect", no_arm)
    with pytest.raises(HalError, match=r"arm: no arm at 192\.0\.2\.1\. camera: no camera at USB\."):
        serve(rig, free_config(), Event())


@pytest.mark.parametrize("independent", [True, False])
def test_an_arm_that_cannot_be_had_leaves_no_camera_connected(
    monkeypatch: pytest.MonkeyPatch, independent: bool
) -> None:
    rig = replace(make_rig(), independent=independent)

    def no_arm() -> None:
        raise HalTimeoutError("no arm at 192.0.2.1.")

    monkeypatch.setattr(rig.arm, "connect", no_arm)
    with pytest.raises(HalTimeoutError, match="no arm"):
        serve(rig, free_config(), Event())
    with pytest.raises(NotConnectedError):
        rig.camera.wait_for_frame(0.1)


def test_a_rig_that_is_parked_goes_soft_when_nothing_ticks_any_more_and_before_it_is_let_go() -> None:
    rig, end = make_rig(), Event()
    folded = np.append(np.zeros(5), 1.0)
    softened: list[np.ndarray] = []
    parking = Parking(q=folded, speed_rad_s=3.0, disable_motors=lambda: softened.append(rig.arm.read_state().q))
    serve(replace(rig, park=parking), free_config(), end, on_ready=end.set)
    assert softened[0][:6] == pytest.approx(folded, abs=1e-2)


def test_an_arm_that_was_stopped_is_neither_parked_nor_softened() -> None:
    rig, end, config = make_rig(), Event(), free_config()
    softened: list[bool] = []

    def stop() -> None:
        with RemoteArm(config) as arm:
            arm.stop("the button")
        end.set()

    parking = Parking(q=np.zeros(6), speed_rad_s=3.0, disable_motors=lambda: softened.append(True))
    serve(replace(rig, park=parking), config, end, on_ready=stop)
    assert softened == []


def test_a_second_signal_is_told_apart_from_the_first() -> None:
    done = subprocess.run([sys.executable, "-c", TWICE], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout == "True False\nTrue True\n"


def test_a_lock_step_rig_is_refused() -> None:
    with pytest.raises(ValueError, match="lock-step rig"):
        serve(replace(make_rig(), call_every_tick=lambda _: None), free_config(), Event())
