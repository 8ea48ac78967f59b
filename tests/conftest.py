"""Settings of the whole suite."""

from __future__ import annotations

import os
import re
import tempfile

import pytest
from hypothesis import settings

pytest_plugins = ["tests.support.faults_table", "tests.support.vendor.table"]

# The same examples in every run, so that a failure is reproducible; to search for new ones:
# HYPOTHESIS_PROFILE=explore ./z1 test
settings.register_profile("ci", derandomize=True, deadline=None, database=None)
settings.register_profile("explore", deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci"))

# Calibration results of this machine must not change a test.
os.environ["Z1_CALIBRATIONS"] = "/nonexistent/calibrations"

# Secrets and sockets of the tests' HALs are kept out of this user's; a short path, which a socket needs.
_RUNTIME_FOLDER = tempfile.TemporaryDirectory(prefix="z1-test-")
os.environ["XDG_RUNTIME_DIR"] = _RUNTIME_FOLDER.name

_OFF_BY_DEFAULT = ("hardware", "slow", "vendor")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Deselect hardware and slow tests unless the -m expression names their marker.

    As an -m in pyproject's addopts they would come back with any -m of the command line, which replaces it.
    """
    unnamed = [name for name in _OFF_BY_DEFAULT if name not in re.findall(r"\w+", config.option.markexpr)]
    left_out = [item for item in items if any(item.get_closest_marker(name) for name in unnamed)]
    config.hook.pytest_deselected(items=left_out)
    items[:] = [item for item in items if item not in left_out]
