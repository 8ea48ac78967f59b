"""An error means the same on both sides of the link."""

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
def test_an_error_keeps_its_class_and_its_text(kind):
    error = _BUILT.get(kind) or kind("joint 2 is hot; let it cool")
    back = decode_error(encode_error(error))
    assert type(back) is kind
    assert str(back) == str(error)


def test_a_class_from_elsewhere_arrives_as_its_nearest_known_parent():
    class PrivateLeaseError(LeaseError):
        pass

    back = decode_error(encode_error(PrivateLeaseError("held by somebody")))
    assert type(back) is LeaseError


@given(st.binary(max_size=60))
def test_garbage_becomes_a_plain_error_that_shows_it(data):
    assert type(decode_error(data)) is HalError


def test_no_class_outside_the_list_is_ever_made():
    assert type(decode_error(msgpack.packb(["SystemExit", "bye"]) or b"")) is HalError
