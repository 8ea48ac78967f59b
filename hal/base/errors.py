"""Errors of the project, rooted at `Z1Error`: the message is for the operator, `code` for programs and tests.

A message reads `<component>: <what failed> (<value>, allowed <range>). <What to do next>.` Packages derive their own
errors from the classes here; a second, builtin parent lets callers catch what they would expect.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import ClassVar


class Z1Error(Exception):
    """Root of all errors that this project raises on purpose.

    Args:
        message: for the operator.
        code: short stable name of the failure; by default the one of the class.
    """

    default_code: ClassVar[str] = "error"

    def __init__(self, message: str = "", *, code: str | None = None) -> None:
        super().__init__(message)
        self.code = code or self.default_code

    def __str__(self) -> str:  # a KeyError parent would show the repr of the message
        return str(self.args[0]) if self.args else ""

    def __reduce__(self) -> tuple[object, ...]:
        # Subclasses build their message from parts; a copy in another process starts from the complete message.
        return _rebuild, (type(self), self.args, self.__dict__)


def _rebuild(kind: type[Z1Error], args: tuple[object, ...], state: dict[str, object]) -> Z1Error:
    error = kind.__new__(kind, *args)
    error.args = args
    error.__dict__.update(state)
    return error


class UsageError(Z1Error, ValueError):
    """An unusable option, file or configuration of the user's; a command ends with exit code 2."""

    default_code = "usage"


class InvalidValueError(UsageError):
    """An argument or a setting out of its range, or of the wrong shape."""

    default_code = "invalid_value"


class ConfigError(UsageError):
    """An unusable configuration file; the message names the key.

    Attributes:
        key: path of the key in the file, such as `planner.lift_m`; empty without one.
    """

    default_code = "invalid_config"

    def __init__(self, message: str = "", *, code: str | None = None, key: str = "") -> None:
        super().__init__(message, code=code)
        self.key = key


class OutputExistsError(UsageError, FileExistsError):
    """A result that would overwrite an earlier one."""

    default_code = "output_exists"


class MissingFileError(Z1Error, FileNotFoundError):
    """A missing file that another command writes."""

    default_code = "missing_file"


class HalError(Z1Error):
    """Root of all errors of the hardware layer."""

    default_code = "hal"


class NotConnectedError(HalError, ConnectionError):
    """A device was used before `connect()` or after `disconnect()`."""

    default_code = "not_connected"

    def __init__(self, device: str) -> None:
        super().__init__(f"{device} is not connected. Call connect() first, or use it in a `with` block.")


class HalTimeoutError(HalError, TimeoutError):
    """A device or the HAL process did not answer in time."""

    default_code = "timeout"


class UnknownBackendError(HalError, UsageError, KeyError):
    """A backend name that is not registered."""

    default_code = "unknown_backend"

    def __init__(self, kind: str, name: str, known: Iterable[str]) -> None:
        super().__init__(f"registry: unknown {kind} backend {name!r} (known: {', '.join(sorted(known))}).")


class InvalidMessageError(HalError, ValueError):
    """A message whose fields have the wrong shape or type, or values that are not finite."""

    default_code = "invalid_message"


class CommandRejectedError(HalError, RuntimeError):
    """A command that the servo rejects; the arm continues its present motion."""

    default_code = "command_rejected"


class StoppedError(CommandRejectedError):
    """A command rejected because the stop is latched: nothing moves until the operator re-arms."""

    default_code = "stopped"

    def __init__(self, reason: str) -> None:
        super().__init__(f"servo: the arm is stopped ({reason}). Inspect it, then re-arm it with `./z1 rearm`.")


class GuardError(CommandRejectedError):
    """A command that leaves the workspace, goes below the table, or brings the arm into collision with itself."""

    default_code = "guard"


class LeaseError(CommandRejectedError):
    """A command of a client that does not own the command lease."""

    default_code = "lease"


class SdkMissingError(HalError, ImportError):
    """A missing vendor library that a backend needs."""

    default_code = "sdk_missing"


class CameraError(HalError, RuntimeError):
    """An unusable image or setting of the camera."""

    default_code = "camera"
