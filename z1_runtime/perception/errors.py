"""Errors of perception: what a frame lacks for a pick."""

from __future__ import annotations

from hal.base.errors import Z1Error


class PerceptionError(Z1Error, RuntimeError):
    """Root of all errors of perception."""

    default_code = "perception"


class NoDepthError(PerceptionError):
    """The depth image is empty."""

    default_code = "no_depth"


class NoDetectionError(PerceptionError):
    """The detector found nothing (of the wanted class)."""

    default_code = "no_detection"


class NoTableError(PerceptionError):
    """No table plane where one was expected."""

    default_code = "no_table"


class SmallCloudError(PerceptionError):
    """Too few points of the object are left after filtering."""

    default_code = "small_cloud"
