"""What a calibration says when it cannot go on, and when it can but somebody should look."""

from __future__ import annotations

from dataclasses import dataclass

from hal.base.errors import Z1Error


class CalibrationError(Z1Error, ValueError):
    """A calibration that cannot be done, read or used; `code` is for programs, the message for the operator."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message, code=code)


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationWarning:
    """Something an operator can act on; the calibration went on without it."""

    code: str
    """Short, stable name: `too_few_poses`, `too_similar_poses`, `wrong_square_size`, `board_moved`, …"""
    message: str
    """What was seen, what is expected, what to do next."""
    samples: tuple[str, ...] = ()
    """Names of the samples it is about; empty when it is about all."""

    def __str__(self) -> str:
        return self.message
