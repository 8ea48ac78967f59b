"""Whether this machine can draw with OpenGL."""

import pytest

from hal.base.errors import CameraError
from sim_twin.camera.render import open_egl


def _has_egl() -> bool:
    try:
        open_egl(16, 16).free()
    except CameraError:
        return False
    return True


needs_egl = pytest.mark.skipif(not _has_egl(), reason="no OpenGL through EGL on this machine")
