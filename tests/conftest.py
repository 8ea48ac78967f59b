"""Settings of the whole suite."""

from __future__ import annotations

import os

from hypothesis import settings

pytest_plugins = ["tests.support.faults_table", "tests.support.vendor.table"]

# The same examples in every run, so that a failure is reproducible; to search for new ones:
# HYPOTHESIS_PROFILE=explore ./z1 test
settings.register_profile("ci", derandomize=True, deadline=None, database=None)
settings.register_profile("explore", deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci"))

# Calibration results of this machine must not change a test.
os.environ["Z1_CALIBRATIONS"] = "/nonexistent/calibrations"
