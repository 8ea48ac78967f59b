"""The doctor's table stands whatever the machine, or a check, does."""

from __future__ import annotations

import socket
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest

from hal.backends.mock_arm import MockArm
from hal.backends.replay_camera import ReplayCamera
from hal.base.clock import WallClock
from hal.bus.server import HalServer
from hal.bus.session import BusConfig
from hal.servo.servo import Servo
from scripts.commands import doctor
from scripts.support import doctor_checks as checks
from scripts.support.doctor_checks import Check, State


def check_good() -> Check:
    return Check("good", State.OK, "fine")


def check_bad() -> Check:
    return Check("bad", State.MISSING, "[gone]", "type this")


def check_that_breaks() -> Check:
    raise RuntimeError("inside the check")


def test_demo_can_run_when_only_welcome_things_are_missing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(doctor, "NEEDED", (check_good,))
    monkeypatch.setattr(doctor, "WELCOME", (check_bad, check_that_breaks))
    assert doctor.main(doctor.DoctorConfig()) == 0
    out = capsys.readouterr().out
    assert "[gone]" in out
    assert "type this" in out
    assert "ready: ./z1 demo" in out


def test_demo_cannot_run_when_something_needed_is_missing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(doctor, "NEEDED", (check_good, check_bad))
    monkeypatch.setattr(doctor, "WELCOME", ())
    assert doctor.main(doctor.DoctorConfig()) == 1
    assert "cannot run yet: see bad" in capsys.readouterr().out


def test_broken_check_becomes_a_row() -> None:
    (row,) = doctor.run_checks([check_that_breaks])
    assert row.state is State.MISSING
    assert row.name == "that breaks"
    assert "inside the check" in row.seen


def test_every_check_answers_on_this_machine() -> None:
    for row in doctor.run_checks([*doctor.NEEDED, *doctor.WELCOME]):
        assert "check itself failed" not in row.seen, row
        assert row.seen
        assert row.fix or row.state is State.OK


def test_port_taken_by_a_stranger_keeps_the_demo_from_running(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        monkeypatch.setattr("hal.bus.session.BusConfig", partial(BusConfig, port=port))
        row = checks.check_bus_port()
    assert row.state is State.MISSING
    assert f"{port} is taken" in row.seen
    assert "./z1 demo --port" in row.fix


def test_port_taken_by_our_own_hal_is_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        bus = BusConfig(port=probe.getsockname()[1])
    monkeypatch.setattr("hal.bus.session.BusConfig", partial(BusConfig, port=bus.port))
    clock = WallClock()
    servo, camera = Servo(MockArm(clock), clock), ReplayCamera(clock=clock)
    servo.connect()
    camera.connect()
    with HalServer(servo, camera, clock, bus):
        row = checks.check_bus_port()
    camera.disconnect()
    servo.disconnect()
    assert row.state is State.WARN
    assert "our own HAL process" in row.seen
    assert "servo holding at 0.0 Hz" in row.seen
    assert "no command owner" in row.seen
    assert "./z1 run" in row.fix


def test_missing_packages_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checks, "_MODULES", ("numpy", "not_a_package"))
    row = checks.check_packages()
    assert (row.state, row.seen) == (State.MISSING, "not installed: not_a_package")


def test_full_disk_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=1e6))
    assert checks.check_disk().state is State.MISSING
    assert checks.check_shared_memory().state is State.WARN


def test_missing_opengl_is_a_warning_with_its_fix(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checks, "_run_python", lambda *args, **more: (1, "Traceback\nImportError: no libEGL"))
    row = checks.check_graphics()
    assert row.state is State.WARN
    assert "no libEGL" in row.seen
    assert "apt install" in row.fix


def test_driver_that_hangs_is_given_up() -> None:
    code, out = checks._run_python("import threading; threading.Event().wait()", timeout_s=0.5)
    assert code != 0
    assert "no answer" in out


def test_arm_on_the_right_network_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checks, "ARM_ADDRESS", "127.0.0.1")
    assert checks._is_there("127.0.0.1")
    assert "not configured" in checks.check_arm().seen  # we speak from 127.0.0.1, not from the arm's network


def test_doctor_reads_the_root_of_this_checkout() -> None:
    assert (checks.ROOT / "pyproject.toml").is_file()
    assert Path(doctor.__file__).is_relative_to(checks.ROOT)
