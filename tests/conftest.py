"""Settings of the whole suite."""

from __future__ import annotations

import os

from hypothesis import settings

pytest_plugins = ["tests.support.faults_table"]

# The suite tries the same examples every time, so that a red run is red again; to look for new ones:
# HYPOTHESIS_PROFILE=explore ./z1 test
settings.register_profile("ci", derandomize=True, deadline=None, database=None)
settings.register_profile("explore", deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci"))

# No test is to find what somebody has calibrated on this machine.
os.environ["Z1_CALIBRATIONS"] = "/nonexistent/calibrations"
