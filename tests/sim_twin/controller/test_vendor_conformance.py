"""The twin's controller against the vendor's: as it was measured, and against a program on this machine."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from tests.support.errors import raises
from tests.support.vendor import program
from tests.support.vendor.line import TwinLine
from tests.support.vendor.observations import LONG, SHORT, Observation, Observer
from tests.support.vendor.probe import Probe
from tests.support.vendor.table import Pair

pytestmark = pytest.mark.integration

MEASURED = Path(program.__file__).parent / "measured.json"
"""Observations of the vendor's controller, built from its public source, with the board twin below it."""


@pytest.mark.parametrize(
    "observe",
    [*SHORT, *(pytest.param(observe, marks=pytest.mark.slow) for observe in (*LONG, program.observe_grants))],
    ids=lambda observe: observe.__name__,
)
def test_the_twin_behaves_as_the_vendors_controller_was_measured(observe: Observer) -> None:
    measured = {values["name"]: Observation(**values) for values in json.loads(MEASURED.read_text())}
    line = TwinLine()
    line.run(0.3)
    found = list(observe(Probe(line)))
    assert found
    for one in found:
        assert measured[one.name].equals(one), (measured[one.name], one)


@pytest.mark.vendor
@pytest.mark.timeout(1800)
def test_the_twin_behaves_as_the_vendors_program(request: pytest.FixtureRequest, vendor_table: list[Pair]) -> None:
    if not (path := os.environ.get("Z1_CTRL")):
        pytest.skip("Z1_CTRL names no controller program")
    vendor = program.observe_program(Path(path), allow_motion=bool(request.config.getoption("--allow-motion")))
    twin = {one.name: one for one in program.observe_twin()}
    vendor_table += [(one, twin[one.name]) for one in vendor]
    assert [pair for pair in vendor_table if not pair[0].equals(pair[1])] == []


def test_a_program_that_would_command_a_real_arm_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ctrl = tmp_path / "build" / "z1_ctrl"
    (tmp_path / "config").mkdir()
    ctrl.parent.mkdir()
    ctrl.write_text("#!/bin/sh\ntouch started\n")
    ctrl.chmod(0o755)
    (tmp_path / "config" / "config.xml").write_text("<configuration><IP>192.168.123.110</IP></configuration>")
    monkeypatch.setattr(program, "can_isolate", lambda: False)
    with raises(program.RealArmError, "real_arm"):
        program.observe_program(ctrl, allow_motion=False)
    assert list(ctrl.parent.iterdir()) == [ctrl]
