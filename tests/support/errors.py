"""Checks of an error's type and code, so that its wording may change."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from hal.base.errors import Z1Error


@contextmanager
def raises(kind: type[Z1Error] | tuple[type[Z1Error], ...], code: str) -> Iterator[pytest.ExceptionInfo[Z1Error]]:
    """Assert that the body raises one of `kind` with that `code`."""
    with pytest.raises(kind) as caught:
        yield caught
    assert caught.value.code == code
