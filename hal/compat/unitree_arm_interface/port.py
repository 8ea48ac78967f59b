"""Substitution of the vendor's `unitree_arm_interface` by ours."""

from __future__ import annotations

from contextlib import AbstractContextManager

from hal.masquerade import install_module, masquerade_module

_NAME = "unitree_arm_interface"
_OURS = f"hal.compat.{_NAME}"


def install() -> None:
    """Make `import unitree_arm_interface` give ours from now on, whatever is installed under that name."""
    install_module(_OURS, _NAME)


def masquerade() -> AbstractContextManager[None]:
    """Substitute for the length of a `with` block, as `install` does."""
    return masquerade_module(_OURS, _NAME)
