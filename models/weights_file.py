"""Arrays of a network on disk: one `.npz` without pickles, and a file with its SHA-256."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from hal.base.errors import InvalidValueError, UsageError
from hal.base.files import atomic_path, atomic_write, read_npz

WEIGHTS_FOLDER = Path(__file__).resolve().parent / "weights"


class WeightsError(UsageError):
    """Weights file that is missing, damaged or of another network."""

    default_code = "weights"


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> str:
    """Write `arrays` to `path` and their SHA-256 next to it; return the latter.

    An existing file stays whole until the new one is complete.

    Raises:
        InvalidValueError: `path` does not end in .npz.
    """
    if path.suffix != ".npz":
        raise InvalidValueError(f"{path} must end in .npz: weights are kept as NumPy arrays.", code="weights_suffix")
    with atomic_path(path) as partial:
        with partial.open("wb") as file:
            np.savez(file, allow_pickle=False, **arrays)
        digest = sha256_of(partial)
    atomic_write(path.with_suffix(".sha256"), f"{digest}  {path.name}\n")
    return digest


def read_arrays(path: Path, make_command: str) -> dict[str, np.ndarray]:
    """Return the arrays of the file at `path`; `make_command` is named in errors as the way to make it.

    Raises:
        WeightsError: the file or its checksum is missing, they differ, or the file holds no plain arrays.
    """
    verify_sha256(path, make_command)
    try:
        return read_npz(path)
    except (ValueError, OSError) as err:
        raise WeightsError(
            f"{path.name} holds no plain NumPy arrays ({err}); make it again with `{make_command}`.",
            code="weights_not_arrays",
        ) from err


def verify_sha256(path: Path, make_command: str) -> str:
    """Return the SHA-256 of the file at `path` after comparing it with its checksum file.

    Raises:
        WeightsError: the file or its checksum is missing, or they differ.
    """
    checksum = path.with_suffix(".sha256")
    for needed in (path, checksum):
        if not needed.is_file():
            raise WeightsError(
                f"{needed} is missing; restore it, or make it with `{make_command}`.", code="weights_missing"
            )
    # Whatever its encoding: a damaged checksum is one that differs
    actual, expected = sha256_of(path), next(iter(checksum.read_text(errors="replace").split()), "nothing")
    if actual != expected:
        raise WeightsError(
            f"{path.name} has SHA-256 {actual[:12]}…, {checksum.name} says {expected[:12]}…: the file is damaged or "
            "was exchanged; restore both from the repository.",
            code="weights_damaged",
        )
    return actual


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of the file at `path`, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
