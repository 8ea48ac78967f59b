"""Backends by name."""

from __future__ import annotations

import pytest

from hal.backends.mock_arm import MockArm
from hal.base.errors import UnknownBackendError
from hal.registry import ARMS, Registry


def test_a_name_becomes_what_it_stands_for_with_its_options() -> None:
    arm = ARMS.make("mock", time_constant_s=0.5)
    assert isinstance(arm, MockArm)


def test_a_name_that_nobody_registered_is_refused_with_those_that_are() -> None:
    with pytest.raises(UnknownBackendError, match=r"no arm backend 'z9'; known: mock, sim, z1\."):
        ARMS.make("z9")


def test_a_name_is_registered_once() -> None:
    arms = Registry("arm", {})
    arms.register("copy", "hal.backends.mock_arm:MockArm")
    assert arms.names() == ["copy"]
    with pytest.raises(ValueError, match="'copy' is registered already, as"):
        arms.register("copy", "somewhere:Else")
