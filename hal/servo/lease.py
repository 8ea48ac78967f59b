"""Command lease: exclusive ownership of the arm, renewed by heartbeat."""

from __future__ import annotations

from hal.base.errors import LeaseError


class Lease:
    """The command lease of one arm.

    Args:
        timeout_s: with the arm at rest, a lease without a heartbeat for so long [s] lapses: another client may claim
            it, and until then the owner revives it by its next heartbeat. None = it never lapses.
    """

    def __init__(self, timeout_s: float | None) -> None:
        self._timeout_s = timeout_s
        self.owner = ""
        """The client that claimed last and has not released; empty when free."""
        self.last_heartbeat_s = 0.0
        """Time of the owner's last heartbeat [s]."""

    def current_owner(self, now_s: float, *, at_rest: bool) -> str:
        """Return the owner at `now_s` [s]; empty when the lease is free or has lapsed."""
        # Not in motion: there the tick brakes at a late heartbeat, and names the owner.
        lapsed = self._timeout_s is not None and at_rest and now_s - self.last_heartbeat_s > self._timeout_s
        return "" if lapsed else self.owner

    def claim(self, owner: str, now_s: float, *, at_rest: bool) -> None:
        """Claim the lease.

        Raises:
            LeaseError: the name is empty (`empty_owner`), or another client owns the lease (`owned_by_other`).
        """
        if not owner:
            raise LeaseError("lease: the owner's name is empty. Claim it with a name.", code="empty_owner")
        current = self.current_owner(now_s, at_rest=at_rest)
        if current not in ("", owner):
            raise LeaseError(
                f"lease: the arm is commanded by {current!r}, so {owner!r} cannot claim it. Wait for its release.",
                code="owned_by_other",
            )
        self.owner, self.last_heartbeat_s = owner, now_s

    def renew(self, owner: str | None, now_s: float) -> None:
        """Record a heartbeat of `owner` (None = the current one) at `now_s` [s].

        Raises:
            LeaseError: the lease is free (`not_claimed`), or another client owns it (`owned_by_other`).
        """
        if not self.owner:
            raise LeaseError("lease: the arm has no owner. Call claim() first.", code="not_claimed")
        if owner not in (None, self.owner):
            raise LeaseError(
                f"lease: the arm is commanded by {self.owner!r}, not by {owner!r}. Call claim() first.",
                code="owned_by_other",
            )
        self.last_heartbeat_s = now_s

    def clear(self) -> None:
        """Free the lease."""
        self.owner = ""
