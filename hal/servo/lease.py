"""Who may command the arm: one owner at a time, who has to show that he is alive."""

from __future__ import annotations

from hal.base.errors import LeaseError


class Lease:
    """The command lease.

    Args:
        timeout_s: with the arm at rest, a lease silent for so long [s] has lapsed: others may claim it, and until
            one does its owner revives it by being heard again. None = never.
    """

    def __init__(self, timeout_s: float | None) -> None:
        self._timeout_s = timeout_s
        self.owner = ""
        """The last one who claimed it and has not released it; empty when nobody."""
        self.last_heartbeat_s = 0.0
        """When he was last heard [s]."""

    def current_owner(self, now_s: float, *, at_rest: bool) -> str:
        """Return who holds it at `now_s` [s]; empty when nobody does or it has lapsed."""
        lapsed = self._timeout_s is not None and at_rest and now_s - self.last_heartbeat_s > self._timeout_s
        return "" if lapsed else self.owner

    def claim(self, owner: str, now_s: float, *, at_rest: bool) -> None:
        """Take it.

        Raises:
            LeaseError: the name is empty, or somebody else holds it.
        """
        if not owner:
            raise LeaseError("the owner of a lease needs a name that is not empty.")
        current_owner = self.current_owner(now_s, at_rest=at_rest)
        if current_owner not in ("", owner):
            raise LeaseError(f"the arm is commanded by {current_owner!r}; {owner!r} has to wait until that one releases it.")
        self.owner, self.last_heartbeat_s = owner, now_s

    def renew(self, owner: str | None, now_s: float) -> None:
        """The owner (None = whoever holds it) was heard at `now_s` [s].

        Raises:
            LeaseError: nobody, or somebody else, holds it.
        """
        if not self.owner:
            raise LeaseError("nobody holds the arm's lease; claim() it first.")
        if owner not in (None, self.owner):
            raise LeaseError(f"the arm is commanded by {self.owner!r}, not by {owner!r}; claim() it first.")
        self.last_heartbeat_s = now_s

    def clear(self) -> None:
        """Nobody holds it."""
        self.owner = ""
