import logging
import os
import subprocess
import sys

import pytest

from hal.base.errors import CameraError, InvalidValueError
from sim_twin.camera import render
from sim_twin.camera.d405 import INTRINSICS
from sim_twin.camera.render import RENDER_VARIABLE, choose, make_renderer
from sim_twin.model.world import World
from tests.support.errors import raises


def _no_gl() -> str:
    raise CameraError("no libEGL;", code="no_egl")


def test_an_unknown_renderer_is_rejected(monkeypatch: pytest.MonkeyPatch, world: World) -> None:
    monkeypatch.setenv(RENDER_VARIABLE, "vulkan")
    with raises(InvalidValueError, "unknown_renderer"):
        make_renderer(world.model, INTRINSICS)


@pytest.mark.parametrize("set_to", [None, "", "auto"])
def test_without_gl_rays_are_cast_with_one_warning(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, set_to: str | None
) -> None:
    monkeypatch.setattr(render, "_warned", False)
    monkeypatch.delenv(RENDER_VARIABLE, raising=False)
    if set_to is not None:
        monkeypatch.setenv(RENDER_VARIABLE, set_to)
    with caplog.at_level(logging.WARNING):
        assert [choose(None, _no_gl, lambda: "rays") for _ in range(2)] == ["rays", "rays"]
    assert [record.message for record in caplog.records if "casts rays" in record.message] == [
        "no libEGL; Until then the twin casts rays, with flat colours."
    ]


def test_gl_that_was_asked_for_and_is_not_there_is_an_error_and_rays_never_try_it() -> None:
    with raises(CameraError, "no_egl"):
        choose("egl", _no_gl, lambda: "rays")
    assert choose("rays", _no_gl, lambda: "rays") == "rays"


@pytest.mark.integration
@pytest.mark.parametrize(
    "environment",
    [
        {"PYOPENGL_PLATFORM": "osmesa"},  # mujoco.egl refuses to be imported
        {"MUJOCO_EGL_DEVICE_ID": "99"},  # no such device
        {"__EGL_VENDOR_LIBRARY_FILENAMES": "/nowhere.json"},  # libEGL without a driver
    ],
)
def test_every_way_of_having_no_egl_ends_with_rays(environment: dict[str, str]) -> None:
    program = (
        "from sim_twin.camera.render import choose, open_egl; "
        "print(choose('auto', lambda: open_egl(16, 16), lambda: 'rays'))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], env={**os.environ, **environment}, capture_output=True, text=True, check=False
    )
    assert done.stdout == "rays\n", done.stderr
    assert done.stderr.count("libgl1-mesa-dri") == 1
