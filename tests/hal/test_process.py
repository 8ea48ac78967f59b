"""The HAL process ends when it is told to; what two processes do to each other is in `bus/test_two_processes.py`."""

from __future__ import annotations

import socket
import subprocess
import sys
from contextlib import ExitStack
from dataclasses import replace
from threading import Event

import pytest

from hal.backends.mock_arm import MockArm, make_rig
from hal.bus import keys
from hal.bus.service import Listener
from hal.bus.session import BusConfig, open_session
from hal.clock import WallClock
from hal.errors import CameraError, HalError, NotConnectedError
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


def test_a_camera_that_cannot_be_had_leaves_no_arm_connected(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = make_rig()

    def fail() -> None:
        raise CameraError("no camera is plugged in")

    monkeypatch.setattr(rig.camera, "connect", fail)
    with pytest.raises(CameraError):
        serve(rig, free_config(), Event())
    with pytest.raises(NotConnectedError):
        rig.arm.read_state()


def test_a_lock_step_rig_is_refused() -> None:
    with pytest.raises(ValueError, match="lock-step rig"):
        serve(replace(make_rig(), call_every_tick=lambda _: None), free_config(), Event())
