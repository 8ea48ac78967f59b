"""Files: YAML into frozen dataclasses, with errors that name file and key; and atomic writing."""

from __future__ import annotations

import difflib
import json
import os
import re
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from reprlib import repr as short_repr
from typing import TYPE_CHECKING, Any, TypeVar, get_type_hints

from hal.base.errors import ConfigError

if TYPE_CHECKING:
    import numpy as np

T = TypeVar("T")
_MAX_TEXT = 4 << 20  # a thousand times the whole configuration
_MAX_ARRAYS = 4 << 30  # forty times the largest weights

_DIGITS = re.compile(r"(\d{20})\d+")  # a number of 400 digits in a reason
_EXTRA, _MISSING, _VALUE = "unexpected_keyword_argument", "missing", "value_error"


def read_yaml(path: Path, what: str) -> Any:
    """Return the content of the YAML file `path`.

    Args:
        path: the file.
        what: its name in an error, such as "the configuration".

    Raises:
        ConfigError: `unreadable` or `not_yaml`.
    """
    from hal.base.strict_yaml import StrictYamlError, load_strict

    try:
        return load_strict(read_text(path))
    except OSError as error:
        raise ConfigError(f"{what} {path} cannot be read: {error.strerror or error}.", code="unreadable") from error
    except UnicodeDecodeError as error:
        raise ConfigError(
            f"{what} {path} is not UTF-8 text ({error.reason}); save it as UTF-8.", code="unreadable"
        ) from error
    except StrictYamlError as error:
        raise ConfigError(f"{what} {path} is not YAML: {error}.", code="not_yaml") from error
    except ValueError as error:  # too large, or a NUL in the name
        raise ConfigError(f"{what} {str(path)!r} cannot be read: {error}.", code="unreadable") from error


def read_text(path: Path) -> str:
    """Return the UTF-8 text of `path`.

    Raises:
        OSError: it cannot be read.
        ValueError: it is not UTF-8, or is larger than 4 MiB.
    """
    with path.open("rb") as file:
        data = file.read(_MAX_TEXT + 1)  # bounded, since a device has no end
    if len(data) > _MAX_TEXT:
        raise ValueError(f"it is larger than {_MAX_TEXT >> 20} MiB")
    return data.decode("utf-8-sig")


def read_npz(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays of the `.npz` file `path`; nothing in it can run code.

    Raises:
        OSError: it cannot be opened.
        ValueError: it is damaged, holds no plain arrays, or more than 4 GiB of them; the message is the reason.
    """
    import numpy as np

    with path.open("rb") as file:
        try:
            with zipfile.ZipFile(file) as archive:
                size = sum(member.file_size for member in archive.infolist())
            if size > _MAX_ARRAYS:
                raise ValueError(f"it expands to {size / 2**30:.0f} GiB, allowed are {_MAX_ARRAYS >> 30}")
            file.seek(0)
            with np.load(file, allow_pickle=False) as arrays:
                return {name: arrays[name] for name in arrays.files}
        except Exception as error:  # zip, zlib, NumPy's headers and the allocation fail in as many ways
            raise ValueError(" ".join(str(error).split())[:160] or type(error).__name__) from error


def plain(value: Any) -> Any:
    """Return `value`, such as of `asdict`, in the types of YAML and JSON: mappings, lists, and paths as text."""
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return str(value) if isinstance(value, Path) else value


def structure(kind: type[T], data: Any, where: str) -> T:
    """Return `data`, as YAML and JSON give it, as the dataclass `kind`; missing keys take their defaults.

    Types are strict: a text is no number, a whole number is a float but not the other way round.

    Raises:
        ConfigError: `unknown_key`, `missing_key`, `wrong_type` or `out_of_range`; the message begins with `where`,
            `key` is the path.
    """
    from pydantic import ValidationError

    try:
        # JSON, since strict mode accepts its lists as tuples and its texts as paths
        return _adapter(kind).validate_json(json.dumps(data), strict=True, extra="forbid")
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        if not isinstance(error, ValidationError):
            raise ConfigError(f"{where} holds values that are no plain data: {error}.", code="wrong_type") from error
        first = error.errors()[0]
        raise _explain(first, kind, where) from error


@cache
def _adapter(kind: type) -> Any:
    from pydantic import TypeAdapter

    return TypeAdapter(kind)


def _explain(found: Mapping[str, Any], kind: type, where: str) -> ConfigError:
    path = tuple(str(part) for part in found["loc"])
    key = ".".join(path)
    if found["type"] == _EXTRA:
        known = [field.name for field in fields(_type_at(kind, path[:-1]))]
        near = difflib.get_close_matches(path[-1], known, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(known)}."
        return ConfigError(f"{where} has an unknown key {key!r}; {hint}", code="unknown_key", key=key)
    if found["type"] == _MISSING and isinstance(found["loc"][-1], str):  # a tuple lacks an index
        return ConfigError(f"{where} lacks the key {key!r}.", code="missing_key", key=key)
    if found["type"] == _VALUE:
        reason = _DIGITS.sub(r"\1...", str(found["ctx"]["error"]))
        return ConfigError(f"{where}: {'.'.join((*path, reason))}", code="out_of_range", key=key)
    expected = found["msg"].replace("Input should be", "it must be").replace("an object", "keys and values")
    return ConfigError(
        f"{where}: {key or 'the content'} is {short_repr(found['input'])}; {expected}.", code="wrong_type", key=key
    )


def _type_at(kind: Any, path: tuple[str, ...]) -> Any:
    """Return the dataclass that the field path leads to."""
    for name in path:
        inner = get_type_hints(kind)[name]
        kind = inner if is_dataclass(inner) else next(part for part in inner.__args__ if is_dataclass(part))
    return kind


PARTIAL = ".partial"
"""Ending of an unfinished file, after the name of the final one; only a killed process leaves one."""


def atomic_write(path: Path, data: bytes | str) -> None:
    """Write `data`, text as UTF-8, to `path`, which is replaced once it is complete."""
    with atomic_path(path) as partial:
        partial.write_bytes(data.encode() if isinstance(data, str) else data)


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a path in the folder of `path` for the content; it replaces `path` at the end, or is removed on an error.

    Its name does not end like that of `path`: a library that appends a missing ending needs an open file.
    """
    # The process id keeps two processes that make the same file apart
    partial = path.with_name(f".{path.name}.{os.getpid()}{PARTIAL}")
    partial.unlink(missing_ok=True)
    # Exclusive: a link that waits under this name would be followed
    os.close(os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
