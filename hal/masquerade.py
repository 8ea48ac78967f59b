"""Substitution of a vendor's module by ours, for unmodified scripts."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager


def install_module(ours: str, *names: str) -> None:
    """Make `import NAME` give our loaded module `ours` from now on, whatever is installed under these `names`."""
    sys.modules |= dict.fromkeys(names, sys.modules[ours])


@contextmanager
def masquerade_module(ours: str, *names: str) -> Iterator[None]:
    """Substitute for the length of a `with` block, as `install_module` does."""
    before = {name: sys.modules.get(name) for name in names}
    install_module(ours, *names)
    try:
        yield
    finally:
        for name, module in before.items():
            if module is None:
                del sys.modules[name]
            else:
                sys.modules[name] = module
