"""Options of the HAL's child process, and its imports."""

from __future__ import annotations

import subprocess
import sys

import pytest
import tyro

from hal.base.errors import InvalidValueError
from hal.bus.session import BusConfig
from scripts.commands import run_hal
from scripts.support.calibration_robot import RobotOptions
from scripts.support.hal_process import decode_options, encode_options
from scripts.support.scene_options import SceneOptions
from sim_twin.model.scene import SceneConfig
from tests.support.errors import raises


def test_options_arrive_as_they_were_sent() -> None:
    scene = SceneOptions(object="box", lateral_m=-0.1, seed=3, mount_error_m=0.004)
    bus = BusConfig(port=7999, shared_memory=False)
    line = encode_options("wire-sim", scene, bus)
    assert line.count(b"\n") == 1
    assert decode_options(line) == ("wire-sim", scene, bus)


def test_scene_options_have_the_scene_s_defaults_and_reach_it() -> None:
    assert SceneOptions().to_scene() == SceneConfig()
    scene = SceneOptions(object="box", distance_m=0.44, mount_error_deg=1.0, mount_seed=2).to_scene()
    assert (scene.object, scene.distance_m, scene.mount_error_deg, scene.mount_seed) == ("box", 0.44, 1.0, 2)


def test_scene_option_out_of_range_is_an_error_of_the_user() -> None:
    with raises(InvalidValueError, "scene_range") as caught:
        SceneOptions(distance_m=2.0).to_scene()
    assert "2.0" in str(caught.value) and "0.3 to 0.65" in str(caught.value)


def test_scene_flags_of_the_hal_have_no_prefix() -> None:
    config = tyro.cli(run_hal.Config, args=["--object=box", "--distance-m=0.4", "--mount-error-m=0.002", "--seed=4"])
    assert config.scene == SceneOptions(object="box", distance_m=0.4, mount_error_m=0.002, seed=4)


@pytest.mark.parametrize(
    ("arguments", "devices"),
    [([], "sim"), (["--devices=remote"], "remote"), (["--hal=real"], "real"), (["--hal=sim"], "sim")],
)
def test_devices_of_a_calibration_have_an_alias(arguments: list[str], devices: str) -> None:
    assert tyro.cli(RobotOptions, args=arguments).devices == devices


@pytest.mark.integration
def test_hal_of_real_devices_does_not_import_the_twin() -> None:
    program = (
        "import sys, tyro; from scripts.commands import run_hal\n"
        "run_hal.make_rig(tyro.cli(run_hal.Config, args=['--mock']))\n"
        "twin = [name for name in sys.modules if name.startswith('sim_twin')]\n"
        "assert not twin, twin"
    )
    subprocess.run([sys.executable, "-P", "-c", program], check=True)
