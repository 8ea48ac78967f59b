"""The doctor prints its table on every machine, also when a check raises."""

from __future__ import annotations

import resource
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
from hal.servo.servo_thread import may_lock_memory
from scripts.commands import doctor
from scripts.support import doctor_checks as checks
from scripts.support.doctor_checks import Check, State


def check_good() -> Check:
    return Check("good", State.OK, "fine")


def check_bad() -> Check:
    return Check("bad", State.MISSING, "[gone]", "type this")


def check_that_breaks() -> Check:
    raise RuntimeError("inside the check")


def test_demo_can_run_when_only_optional_parts_are_missing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(doctor, "REQUIRED", (check_good,))
    monkeypatch.setattr(doctor, "OPTIONAL", (check_bad, check_that_breaks))
    assert doctor.main(doctor.DoctorConfig()) == 0
    out = capsys.readouterr().out
    assert "[gone]" in out
    assert "type this" in out
    assert "ready: ./z1 demo" in out


def test_demo_cannot_run_when_a_required_part_is_missing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(doctor, "REQUIRED", (check_good, check_bad))
    monkeypatch.setattr(doctor, "OPTIONAL", ())
    assert doctor.main(doctor.DoctorConfig()) == 1
    assert "cannot run yet: see bad" in capsys.readouterr().out


def test_broken_check_becomes_a_row() -> None:
    (row,) = doctor.run_checks([check_that_breaks])
    assert row.state is State.MISSING
    assert row.name == "that breaks"
    assert "inside the check" in row.found


@pytest.mark.integration
def test_every_check_answers_on_this_machine() -> None:
    for row in doctor.run_checks([*doctor.REQUIRED, *doctor.OPTIONAL]):
        assert "check itself failed" not in row.found, row
        assert row.found
        assert row.fix or row.state is State.OK


@pytest.mark.integration
def test_port_taken_by_another_program_prevents_the_demo(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        monkeypatch.setattr("hal.bus.session.BusConfig", partial(BusConfig, port=port))
        row = checks.check_bus_port()
    assert row.state is State.MISSING
    assert f"{port} is taken" in row.found
    assert "./z1 demo --port" in row.fix


@pytest.mark.integration
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
    assert "a HAL process of this project" in row.found
    assert "servo holding at 0.0 Hz" in row.found
    assert "no command owner" in row.found
    assert "./z1 run" in row.fix


def test_missing_packages_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checks, "_MODULES", ("numpy", "not_a_package"))
    row = checks.check_packages()
    assert (row.state, row.found) == (State.MISSING, "not installed: not_a_package")


def test_full_disk_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=1e6))
    assert checks.check_disk().state is State.MISSING
    assert checks.check_shared_memory().state is State.WARN


def test_missing_opengl_is_a_warning_with_its_fix(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checks, "_run_python", lambda *args, **more: (1, "Traceback\nImportError: no libEGL"))
    row = checks.check_graphics()
    assert row.state is State.WARN
    assert "no libEGL" in row.found
    assert "apt install" in row.fix


@pytest.mark.integration
def test_hanging_driver_times_out() -> None:
    code, out = checks._run_python("import threading; threading.Event().wait()", timeout_s=0.5)
    assert code != 0
    assert "no answer" in out


def test_arm_is_probed_on_its_own_network_only(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checks, "ARM_ADDRESS", "127.0.0.1")
    assert checks._is_there("127.0.0.1")
    assert "not configured" in checks.check_arm().found  # the route starts at 127.0.0.1, not in the arm's network


def test_doctor_uses_the_root_of_this_checkout() -> None:
    assert (checks.ROOT / "pyproject.toml").is_file()
    assert Path(doctor.__file__).is_relative_to(checks.ROOT)


@pytest.mark.parametrize(
    ("hard_limit", "state"), [(resource.RLIM_INFINITY, State.OK), (512 << 20, State.WARN), (64 << 20, State.WARN)]
)
def test_locked_memory_is_granted_where_the_servo_uses_it(
    monkeypatch: pytest.MonkeyPatch, hard_limit: int, state: State
) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda _: (hard_limit, hard_limit))
    assert checks.check_locked_memory().state is state
    assert may_lock_memory() is (state is State.OK)
