"""The HAL process and its end; tests of two processes are in `bus/test_two_processes.py`."""

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
from hal.backends.no_camera import NoCamera
from hal.base.clock import WallClock
from hal.base.errors import CameraError, HalError, HalTimeoutError, InvalidValueError, NotConnectedError
from hal.bus import keys
from hal.bus.client import RemoteArm
from hal.bus.service import Listener
from hal.bus.session import BusConfig, open_session
from hal.parking import Parking
from hal.process import serve
from hal.rig import Rig, connect_remote
from hal.servo.servo import Servo
from tests.support.errors import raises

pytestmark = pytest.mark.integration

SIGNALLED = """
import signal, threading
from hal.process import stop_on_signals
ended = threading.Event()
stop_on_signals(ended)
with ended._cond:  # as the main thread holds it for a moment at each poll of the event
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


def test_a_signal_while_the_event_is_polled_ends_the_process_and_does_not_hang_it() -> None:
    done = subprocess.run([sys.executable, "-c", SIGNALLED], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout == "True\n"


def free_config() -> BusConfig:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return BusConfig(port=probe.getsockname()[1])


class StoppableArm(MockArm):
    """An arm that counts its stops, and that raises an unexpected error once `broken` is set."""

    broken = False
    stops = 0

    def read_state(self):
        if self.broken:
            raise ZeroDivisionError("a bug in the driver")
        return super().read_state()

    def stop(self) -> None:
        self.stops += 1
        super().stop()


def test_an_error_in_the_servo_ends_the_process_with_that_error_and_the_arm_stopped() -> None:
    arm = StoppableArm(WallClock())

    def break_it() -> None:
        arm.broken = True

    with pytest.raises(ZeroDivisionError):
        serve(replace(make_rig(), arm=arm), free_config(), Event(), on_ready=break_it)
    assert arm.stops == 1
    arm.broken = False
    with pytest.raises(NotConnectedError):
        arm.read_state()


def test_a_thread_of_the_server_that_fails_for_good_stops_the_arm_and_the_process_goes_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rig, config, ended = make_rig(), free_config(), Event()
    failures: list[None] = []
    reasons: list[str] = []
    stop = Servo.stop

    def fail(_: float) -> None:
        failures.append(None)
        raise ZeroDivisionError("a defect")

    def stop_and_end(servo: Servo, reason: str = "") -> None:
        reasons.append(reason)
        stop(servo, reason)
        ended.set()

    monkeypatch.setattr(rig.camera, "wait_for_frame", fail)
    monkeypatch.setattr(Servo, "stop", stop_and_end)
    with ExitStack() as undo:

        def listen() -> None:
            session = undo.enter_context(open_session(config, listen=False))
            undo.callback(Listener(session, keys.FRAME, lambda _: None).close)

        serve(rig, config, ended, on_ready=listen)
    assert len(failures) == 4, "it is started again three times"
    assert "a thread of the HAL's link failed" in reasons[0]


class WatchedArm(MockArm):
    """An arm that keeps the names of the calls that concern its connection."""

    def __init__(self) -> None:
        super().__init__(WallClock())
        self.calls: list[str] = []

    def find(self) -> None:
        self.calls.append("find")

    def connect(self) -> None:
        self.calls.append("connect")
        super().connect()

    def give_back(self) -> None:
        self.calls.append("give back")

    def disconnect(self) -> None:
        self.calls.append("disconnect")
        super().disconnect()


def watched_rig() -> tuple[Rig, WatchedArm]:
    arm = WatchedArm()
    return replace(make_rig(), arm=arm, find_arm=arm.find, give_back=arm.give_back), arm


def test_a_missing_camera_leaves_the_arm_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    rig, arm = watched_rig()

    def fail() -> None:
        raise CameraError("no camera is plugged in")

    monkeypatch.setattr(rig.camera, "connect", fail)
    with raises(CameraError, "camera"):
        serve(rig, free_config(), Event())
    assert arm.calls == ["find"]


def test_without_arm_and_camera_both_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    rig, arm = watched_rig()

    def no_camera() -> None:
        raise HalTimeoutError("no camera at USB.")

    def no_arm() -> None:
        raise HalTimeoutError("no arm at 192.0.2.1.")

    monkeypatch.setattr(rig.camera, "connect", no_camera)
    with raises(HalError, "devices") as caught:
        serve(replace(rig, find_arm=no_arm), free_config(), Event())
    assert str(caught.value) == "arm: no arm at 192.0.2.1. camera: no camera at USB."
    assert arm.calls == []


def test_a_missing_arm_leaves_no_camera_connected(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = make_rig()

    def no_arm() -> None:
        raise HalTimeoutError("no arm at 192.0.2.1.")

    monkeypatch.setattr(rig.arm, "connect", no_arm)
    with raises(HalTimeoutError, "timeout"):
        serve(rig, free_config(), Event())
    with pytest.raises(NotConnectedError):
        rig.camera.wait_for_frame(0.1)


def test_a_start_that_fails_after_the_arm_was_connected_gives_it_back() -> None:
    rig, arm = watched_rig()
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(HalError):
            serve(rig, BusConfig(port=taken.getsockname()[1]), Event())
    assert arm.calls == ["connect", "give back", "disconnect"]


def test_an_end_after_the_start_does_not_give_the_arm_back() -> None:
    rig, arm = watched_rig()
    end = Event()
    serve(rig, free_config(), end, on_ready=end.set)
    assert arm.calls == ["connect", "disconnect"]


def test_an_arm_alone_is_served_and_a_frame_is_an_error_of_the_camera() -> None:
    rig, end, config = replace(make_rig(), camera=NoCamera()), Event(), free_config()
    seen = []

    def move() -> None:
        with connect_remote(config, "alone", camera=False) as devices:
            seen.append(devices.arm.read_state().q.shape)
            with raises(CameraError, "no_camera"):
                devices.camera.wait_for_frame(0.1)
        end.set()

    serve(rig, config, end, on_ready=move)
    assert seen == [(7,)]


def test_the_motors_of_a_parked_arm_are_disabled_after_the_last_tick_and_before_the_disconnect() -> None:
    rig, end = make_rig(), Event()
    folded = np.append(np.zeros(5), 1.0)
    disabled: list[np.ndarray] = []
    parking = Parking(q=folded, speed_rad_s=3.0, disable_motors=lambda: disabled.append(rig.arm.read_state().q))
    serve(replace(rig, park=parking), free_config(), end, on_ready=end.set)
    assert disabled[0][:6] == pytest.approx(folded, abs=1e-2)


def test_a_stopped_arm_is_neither_parked_nor_disabled() -> None:
    rig, end, config = make_rig(), Event(), free_config()
    disabled: list[bool] = []

    def stop() -> None:
        with RemoteArm(config) as arm:
            arm.stop("the button")
        end.set()

    parking = Parking(q=np.zeros(6), speed_rad_s=3.0, disable_motors=lambda: disabled.append(True))
    serve(replace(rig, park=parking), config, end, on_ready=stop)
    assert disabled == []


def test_a_second_signal_sets_the_second_event() -> None:
    done = subprocess.run([sys.executable, "-c", TWICE], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout == "True False\nTrue True\n"


def test_a_lock_step_rig_is_rejected() -> None:
    with raises(InvalidValueError, "lockstep_rig"):
        serve(replace(make_rig(), call_every_tick=lambda _: None), free_config(), Event())
