"""Authentication codes of requests and answers, and the lease's authority."""

from __future__ import annotations

import os
from dataclasses import replace

import pytest

from hal.base.errors import HalError, InvalidMessageError
from hal.bus import keys
from hal.bus.authentication import LeaseAuthority, LeaseGrant, Request, open_answer, sign_answer
from tests.support.errors import raises

SECRET = os.urandom(32)


def make_request(secret: bytes | None = SECRET, counter: int = 1, key: str = keys.CHUNK) -> Request:
    return Request.make(secret, key, b"payload", "client", counter)


@pytest.mark.parametrize(
    "change",
    [
        {"key": keys.STOP},
        {"payload": b"Payload"},
        {"name": "clienu"},
        {"counter": 2},
        {"nonce": bytes(16)},
        {"code": bytes(32)},
        {"name": "clientp", "payload": b"ayload"},
    ],
)
def test_a_change_of_any_field_breaks_the_code(change):
    request = make_request()
    assert request.is_signed_by(SECRET)
    assert not replace(request, **change).is_signed_by(SECRET)
    assert not request.is_signed_by(os.urandom(32))


def test_a_request_crosses_as_an_attachment():
    request = make_request()
    received = Request.unpack(request.key, request.payload, request.pack())
    assert received == request
    assert received.is_signed_by(SECRET)


@pytest.mark.parametrize("attachment", [b"", bytes(55), bytes(56) + b"\xff", bytes(56) + b"x" * 201])
def test_an_unreadable_attachment_is_rejected(attachment):
    with raises(InvalidMessageError, "invalid_request"):
        Request.unpack(keys.CHUNK, b"", attachment)


def test_an_answer_opens_only_with_its_request_kind_and_secret():
    request = make_request()
    data = sign_answer(SECRET, request, "answer", b"body")
    assert open_answer(SECRET, request, "answer", data) == b"body"
    assert open_answer(SECRET, make_request(), "answer", data) is None
    assert open_answer(SECRET, request, "error", data) is None
    assert open_answer(os.urandom(32), request, "answer", data) is None
    assert open_answer(SECRET, request, "answer", data[:-1]) is None
    assert open_answer(SECRET, request, "answer", b"") is None


@pytest.fixture
def granted() -> tuple[LeaseAuthority, LeaseGrant]:
    authority = LeaseAuthority()
    grant = authority.grant_for(make_request(key=keys.CLAIM))
    authority.put_in_force(grant)
    return authority, grant


def test_a_message_counts_once_and_in_order(granted):
    authority, grant = granted
    for counter, owner in ((5, grant.owner), (5, authority.UNVERIFIED), (4, authority.UNVERIFIED), (6, grant.owner)):
        assert authority.owner_of(make_request(grant.key, counter)) == owner
    # Each key has its own thread, so its own order.
    assert authority.owner_of(make_request(grant.key, 1, keys.SEND)) == grant.owner


def test_without_a_grant_or_with_a_wrong_secret_no_message_has_an_owner(granted):
    authority, grant = granted
    assert LeaseAuthority().owner_of(make_request(grant.key)) == LeaseAuthority.UNVERIFIED
    assert authority.owner_of(make_request(None)) == authority.UNVERIFIED
    assert authority.owner_of(make_request(SECRET)) == authority.UNVERIFIED


def test_a_new_grant_ends_the_one_before(granted):
    authority, grant = granted
    new = authority.grant_for(make_request(key=keys.CLAIM))
    assert authority.owner_of(make_request(grant.key)) == grant.owner  # not yet in force
    authority.put_in_force(new)
    assert authority.owner_of(make_request(grant.key, 9)) == authority.UNVERIFIED
    assert new.owner != grant.owner


def test_the_owner_keeps_its_grant_by_its_proof(granted):
    authority, grant = granted
    proof = Request.make(SECRET, keys.CLAIM, grant.prove(), "client", 1)
    assert authority.grant_for(proof) is grant
    authority.owner_of(make_request(grant.key, 5))
    authority.put_in_force(grant)
    assert authority.owner_of(make_request(grant.key, 5)) == authority.UNVERIFIED  # its counters continue
    assert authority.grant_for(replace(proof, payload=LeaseGrant.draw("client").prove())) is not grant


def test_a_claim_made_before_is_rejected():
    authority, claim = LeaseAuthority(), make_request(key=keys.CLAIM)
    authority.check_claim(claim)
    with raises(HalError, "repeated_claim"):
        authority.check_claim(claim)
    authority.check_claim(make_request(key=keys.CLAIM))
