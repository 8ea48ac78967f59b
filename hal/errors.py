"""Every error the hardware layer raises, rooted at `HalError`; each says what was seen, what is allowed, what to do."""

from __future__ import annotations

from collections.abc import Iterable


class HalError(Exception):
    """Root of all errors of the hardware layer."""


class NotConnectedError(HalError, ConnectionError):
    """A device was used before `connect()` or after `disconnect()`."""

    def __init__(self, device: str) -> None:
        super().__init__(f"{device} is not connected: call connect() first, or use it in a `with` block.")


class HalTimeoutError(HalError, TimeoutError):
    """A device or the HAL process did not answer in time."""


class UnknownBackendError(HalError, KeyError):
    """A backend name that nobody registered."""

    def __init__(self, kind: str, name: str, known: Iterable[str]) -> None:
        super().__init__(f"there is no {kind} backend {name!r}; known: {', '.join(sorted(known))}.")

    def __str__(self) -> str:  # KeyError would show the repr of the sentence
        return str(self.args[0])


class InvalidMessageError(HalError, ValueError):
    """A message whose fields have the wrong shape, type, or values that are not finite."""


class CommandRefusedError(HalError, RuntimeError):
    """The servo will not take this command; the arm keeps doing what it did."""


class StoppedError(CommandRefusedError):
    """The stop is latched: nothing moves until somebody re-arms by hand."""

    def __init__(self, reason: str) -> None:
        super().__init__(f"the arm is stopped ({reason}); look at it, then re-arm with `./z1 rearm`.")


class GuardError(CommandRefusedError):
    """The command leads where the arm may not be: out of its workspace, below the table, or into itself."""


class LeaseError(CommandRefusedError):
    """Another process owns the arm, or this one has lost it."""


class SdkMissingError(HalError, ImportError):
    """A vendor's library that a backend needs cannot be imported here."""


class CameraError(HalError, RuntimeError):
    """The camera delivered something that cannot be used."""
