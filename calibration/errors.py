"""Errors and warnings of the calibration."""

from __future__ import annotations

from dataclasses import dataclass

from hal.base.errors import UsageError, Z1Error


class CalibrationError(Z1Error, ValueError):
    """A calibration that cannot be done, read or used."""

    default_code = "calibration"


class CalibrationFileError(CalibrationError, UsageError):
    """A calibration result or a folder of samples that cannot be used."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationWarning:
    """A finding that an operator can act on; the calibration continued."""

    code: str
    """Short, stable name: `too_few_poses`, `too_similar_poses`, `wrong_square_size`, `board_moved`, …"""
    message: str
    """What was found, what is expected, what to do next."""
    samples: tuple[str, ...] = ()
    """Names of the affected samples; empty when all are."""

    def __str__(self) -> str:
        return self.message
