"""Settings of the whole suite."""

from __future__ import annotations

import os
import tempfile

from hypothesis import settings

pytest_plugins = ["tests.support.faults_table"]

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
