"""How `import unitree_arm_interface` comes to mean ours."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

_NAME = "unitree_arm_interface"


def install() -> None:
    """Let `import unitree_arm_interface` give ours from now on, whatever lies on the path."""
    sys.modules[_NAME] = sys.modules[f"hal.compat.{_NAME}"]


@contextmanager
def masquerade() -> Iterator[None]:
    """Do so for the length of a `with` block."""
    before = sys.modules.get(_NAME)
    install()
    try:
        yield
    finally:
        if before is None:
            del sys.modules[_NAME]
        else:
            sys.modules[_NAME] = before
