"""The error codec keeps class, code and text over the link."""

from __future__ import annotations

import inspect

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

import hal.base.errors
from hal.base.errors import HalError, LeaseError, NotConnectedError, StoppedError, UnknownBackendError
from hal.bus.error_codec import decode_error, encode_error

_BUILT = {
    NotConnectedError: NotConnectedError("the arm"),
    StoppedError: StoppedError("knocked over"),
    UnknownBackendError: UnknownBackendError("arm", "z9", ["sim", "mock"]),
}
_KINDS = [kind for _, kind in inspect.getmembers(hal.base.errors, inspect.isclass) if issubclass(kind, HalError)]


@pytest.mark.parametrize("kind", _KINDS)
def test_an_error_keeps_its_class_code_and_text(kind):
    error = _BUILT.get(kind) or kind("servo: joint2 is at 81 °C (allowed 80 °C). Let it cool.", code="overheated")
    back = decode_error(encode_error(error))
    assert (type(back), back.code, str(back)) == (kind, error.code, str(error))


@pytest.mark.parametrize("kind", _KINDS)
def test_an_error_without_a_code_of_its_own_keeps_the_one_of_its_class(kind):
    error = _BUILT.get(kind) or kind("the arm is silent")
    assert decode_error(encode_error(error)).code == kind.default_code


def test_every_class_has_a_code_of_its_own():
    assert len({kind.default_code for kind in _KINDS}) == len(_KINDS)


def test_a_class_from_elsewhere_arrives_as_its_nearest_known_parent():
    class PrivateLeaseError(LeaseError):
        pass

    back = decode_error(encode_error(PrivateLeaseError("owned by another", code="owned_by_other")))
    assert (type(back), back.code) == (LeaseError, "owned_by_other")


@given(st.binary(max_size=60))
def test_unreadable_bytes_become_a_plain_error(data):
    error = decode_error(data)
    assert (type(error), error.code) == (HalError, "unreadable_error")


def test_no_class_outside_the_list_is_ever_constructed():
    assert type(decode_error(msgpack.packb(["SystemExit", "bye"]) or b"")) is HalError
