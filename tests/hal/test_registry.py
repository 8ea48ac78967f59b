"""The registry of backends."""

from __future__ import annotations

from hal.backends.mock_arm import MockArm
from hal.base.errors import InvalidValueError, UnknownBackendError
from hal.rig import ARMS, Registry
from tests.support.errors import raises


def test_a_name_makes_its_backend_with_the_options() -> None:
    arm = ARMS.make("mock", time_constant_s=0.5)
    assert isinstance(arm, MockArm)


def test_an_unknown_name_is_rejected_with_the_known_ones() -> None:
    with raises(UnknownBackendError, "unknown_backend") as caught:
        ARMS.make("z9")
    assert str(caught.value) == "registry: unknown arm backend 'z9' (known: mock, sim, z1)."


def test_a_name_is_registered_once() -> None:
    arms = Registry("arm", {})
    arms.register("copy", "hal.backends.mock_arm:MockArm")
    assert arms.names() == ["copy"]
    with raises(InvalidValueError, "name_taken"):
        arms.register("copy", "somewhere:Else")
