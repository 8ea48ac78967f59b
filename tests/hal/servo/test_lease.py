"""The command lease alone; its effect on commands is in `test_command_mailbox.py`."""

from __future__ import annotations

from hal.base.errors import LeaseError
from hal.servo.lease import Lease
from tests.support.errors import raises


def test_one_owner_at_a_time_until_it_releases() -> None:
    lease = Lease(timeout_s=1.0)
    lease.claim("a", 0.0, at_rest=True)
    with raises(LeaseError, "owned_by_other") as caught:
        lease.claim("b", 0.5, at_rest=True)
    for part in ("'a'", "'b'", "Wait for its release"):
        assert part in str(caught.value)
    lease.clear()
    lease.claim("b", 0.5, at_rest=True)
    assert lease.current_owner(0.5, at_rest=True) == "b"


def test_the_owner_may_claim_again() -> None:
    lease = Lease(timeout_s=1.0)
    lease.claim("a", 0.0, at_rest=True)
    lease.claim("a", 0.5, at_rest=True)
    assert lease.last_heartbeat_s == 0.5


def test_an_empty_name_cannot_own_it() -> None:
    with raises(LeaseError, "empty_owner"):
        Lease(timeout_s=1.0).claim("", 0.0, at_rest=True)


def test_it_lapses_only_at_rest_and_is_revived_by_a_heartbeat() -> None:
    lease = Lease(timeout_s=1.0)
    lease.claim("a", 0.0, at_rest=True)
    assert lease.current_owner(5.0, at_rest=False) == "a"
    assert lease.current_owner(5.0, at_rest=True) == ""
    lease.renew("a", 5.0)
    assert lease.current_owner(5.5, at_rest=True) == "a"


def test_without_a_timeout_it_never_lapses() -> None:
    lease = Lease(timeout_s=None)
    lease.claim("a", 0.0, at_rest=True)
    assert lease.current_owner(1e6, at_rest=True) == "a"


def test_a_heartbeat_needs_the_owner() -> None:
    lease = Lease(timeout_s=1.0)
    with raises(LeaseError, "not_claimed"):
        lease.renew("a", 0.0)
    lease.claim("a", 0.0, at_rest=True)
    with raises(LeaseError, "owned_by_other"):
        lease.renew("b", 0.1)
    lease.renew(None, 0.2)
    assert lease.last_heartbeat_s == 0.2
