"""Arrays of a network on disk: one `.npz` without pickles, and its SHA-256 beside it."""

from __future__ import annotations

import hashlib
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from hal.base.errors import InvalidValueError, Z1Error

WEIGHTS_FOLDER = Path(__file__).resolve().parent / "weights"


class WeightsError(Z1Error, ValueError):
    """A weights file that is missing, damaged or of another network."""

    default_code = "weights"


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> str:
    """Write `arrays` to `path` and their SHA-256 beside it; return the latter.

    What lies there already stays whole until the new file is.

    Raises:
        ValueError: `path` does not end in .npz.
    """
    if path.suffix != ".npz":
        raise InvalidValueError(f"{path} must end in .npz: weights are kept as NumPy arrays.")
    partial = path.with_name(f".{path.stem}.{os.getpid()}.npz")
    try:
        np.savez(partial, allow_pickle=False, **arrays)
        digest = sha256_of(partial)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
    path.with_suffix(".sha256").write_text(f"{digest}  {path.name}\n")
    return digest


def read_arrays(path: Path, maker: str) -> dict[str, np.ndarray]:
    """Return the arrays of the file at `path`; `maker` is the command that makes such a file.

    Raises:
        WeightsError: the file or its checksum is missing, they do not agree, or the file holds no plain arrays.
    """
    checked_sha256(path, maker)
    try:
        with np.load(path, allow_pickle=False) as file:
            return {key: file[key] for key in file.files}
    except (ValueError, OSError, AttributeError, zipfile.BadZipFile) as err:
        raise WeightsError(f"{path.name} holds no plain NumPy arrays ({err}); make it anew with `{maker}`.") from err


def checked_sha256(path: Path, maker: str) -> str:
    """Return the SHA-256 of the file at `path`, if it is the one beside it; `maker` is the command that makes both.

    Raises:
        WeightsError: the file or its checksum is missing, or they do not agree.
    """
    checksum = path.with_suffix(".sha256")
    for needed in (path, checksum):
        if not needed.is_file():
            raise WeightsError(f"{needed} is missing; restore it, or make it with `{maker}`.")
    seen, wanted = sha256_of(path), next(iter(checksum.read_text().split()), "nothing")
    if seen != wanted:
        raise WeightsError(
            f"{path.name} has SHA-256 {seen[:12]}…, {checksum.name} says {wanted[:12]}…: the file is damaged or was "
            "exchanged; restore both from the repository."
        )
    return seen


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of the file at `path`, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
