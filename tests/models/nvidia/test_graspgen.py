"""NVIDIA's packages with small random checkpoints in their real file format; skipped where they are not installed.

`uv sync --inexact --extra graspgen --extra graspgenx` installs them (GraspGen's: research and evaluation only).
"""

from __future__ import annotations

import importlib.util
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from hal.base.errors import InvalidValueError
from models.nvidia.errors import GeneratorError
from models.nvidia.nvidia import NvidiaSampler, load_in_process
from models.nvidia.process import ProcessGenerator
from models.nvidia.torch_patches import cuda_if_available, fold_attention, seed_random_numbers
from models.types import GraspGenerator
from tests.support.errors import raises

CLOUD = np.random.default_rng(0).uniform([-0.03, -0.05, 0.38], [0.03, 0.05, 0.42], (700, 3))


def needs(package: str) -> pytest.MarkDecorator:
    missing = importlib.util.find_spec(package) is None
    return pytest.mark.skipif(missing, reason=f"{package} is not installed (an extra of this project)")


NAMES = [pytest.param("graspgen", marks=needs("grasp_gen")), pytest.param("graspgenx", marks=needs("graspgenx"))]


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory):
    """Return a function that makes, once each, the checkpoint of a name."""
    made: dict[str, Path] = {}

    def make(name: str) -> Path:
        from tests.support.nvidia_checkpoints import write_graspgen, write_graspgenx

        if name not in made:
            folder = tmp_path_factory.mktemp(name)
            made[name] = write_graspgen(folder) if name == "graspgen" else write_graspgenx(folder / "release")
        return made[name]

    return make


@pytest.fixture(scope="module")
def loaded(checkpoints):
    """Return a function that loads, once each, the generator of a name."""
    made: dict[str, GraspGenerator] = {}

    def load(name: str) -> NvidiaSampler:
        if name not in made:
            made[name] = load_in_process(name, checkpoints(name))
        generator = made[name]
        assert isinstance(generator, NvidiaSampler)
        return generator

    return load


@pytest.mark.parametrize("name", NAMES)
def test_a_checkpoint_gives_the_requested_number_of_rigid_grasps_best_first(name, loaded):
    grasps = loaded(name).sample(CLOUD, 37, 0)
    R = grasps.T_camera_grasps[:, :3, :3]
    assert len(grasps) == 37 and grasps.source.startswith(name)
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.tile(np.eye(3), (37, 1, 1)), atol=1e-5)
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-5)
    assert (np.diff(grasps.scores) <= 0.0).all() and np.ptp(grasps.scores) > 0.0
    assert grasps.scores.min() >= 0.0 and grasps.scores.max() <= 1.0
    assert np.isnan(grasps.widths_m).all()


@pytest.mark.parametrize("name", NAMES)
def test_the_same_seed_gives_the_same_grasps_and_another_seed_others(name, loaded):
    first, again, other = (loaded(name).sample(CLOUD, 10, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.T_camera_grasps, again.T_camera_grasps)
    np.testing.assert_array_equal(first.scores, again.scores)
    assert not np.allclose(first.T_camera_grasps, other.T_camera_grasps)


@pytest.mark.parametrize("name", NAMES)
def test_the_grasps_are_those_of_the_package_moved_to_the_fingertips_and_turned(name, loaded):
    ours = loaded(name).sample(CLOUD, 12, 4)
    order = np.random.default_rng(4).permutation(len(CLOUD))
    theirs = loaded(name)._sampler
    with cuda_if_available(), seed_random_numbers(4):
        T, scores, _ = theirs.sample(torch.from_numpy(CLOUD[order]).float(), -1.0, 12, remove_outliers=False)
    best_first = torch.argsort(-scores, stable=True)
    T = T[best_first].double().numpy()
    depth_m = 0.195 if name == "graspgen" else 0.140
    tips = T[:, :3, 3] + depth_m * T[:, :3, 2]
    np.testing.assert_allclose(ours.T_camera_grasps[:, :3, 3], tips, atol=1e-4)
    np.testing.assert_allclose(ours.T_camera_grasps[:, :3, 2], T[:, :3, 2], atol=1e-4)  # approach
    np.testing.assert_allclose(ours.T_camera_grasps[:, :3, 1], T[:, :3, 0], atol=1e-4)  # closing
    np.testing.assert_allclose(ours.scores, scores[best_first].numpy(), atol=1e-4)


@needs("grasp_gen")
def test_the_packages_control_points_are_on_our_closing_axis():
    from grasp_gen.robot import get_gripper_info

    from models.nvidia.nvidia import T_NVIDIA_GRASP

    info = get_gripper_info("robotiq_2f_140")
    tips = info.control_points.double().numpy()[:, 2:4]  # base, homogeneous: the two fingertips
    T_base_grasp = info.transform_from_base_link_to_tool_tcp @ T_NVIDIA_GRASP
    local = np.linalg.inv(T_base_grasp) @ tips
    np.testing.assert_allclose(local[:3].T, [[0.0, 0.068017, 0.0], [0.0, -0.068017, 0.0]], atol=1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_folded_attention_differs_by_rounding_only(name, checkpoints, loaded):
    if name == "graspgen":
        from grasp_gen.grasp_server import load_grasp_cfg
        from grasp_gen.models.generator import GraspGenGenerator

        cfg = load_grasp_cfg(str(checkpoints(name))).diffusion
        state = torch.load(checkpoints(name).with_name("gen.pth"))["model"]
    else:
        from graspgenx.models.generator import GraspGenGenerator
        from omegaconf import OmegaConf

        cfg = OmegaConf.load(checkpoints(name) / "gen" / "config.yaml").diffusion
        state = torch.load(checkpoints(name) / "gen" / "epoch_10.pth")["model"]
    network = GraspGenGenerator.from_config(cfg).eval()
    network.load_state_dict(state)
    head = network.diffusion_head
    observation = torch.randn(20, 64 if name == "graspgen" else 1024)
    sample, t = torch.randn(20, 6), torch.tensor(7)
    with torch.inference_mode():
        before = head(observation, t, sample)
        assert fold_attention(head) == 3
        after = head(observation, t, sample)
    np.testing.assert_allclose(after, before, atol=2e-6)
    folded = loaded(name)._sampler.model.grasp_generator.diffusion_head
    assert not any(isinstance(module, torch.nn.MultiheadAttention) for module in folded.modules())


@pytest.mark.parametrize("name", NAMES)
def test_a_process_of_its_own_gives_the_same_grasps(name, checkpoints, loaded):
    generator = ProcessGenerator(name, checkpoints(name), Path(sys.executable))
    try:
        there, here = generator.sample(CLOUD, 9, 3), loaded(name).sample(CLOUD, 9, 3)
        np.testing.assert_allclose(there.T_camera_grasps, here.T_camera_grasps, atol=1e-5)
        np.testing.assert_allclose(there.scores, here.scores, atol=1e-6)
        assert there.source == here.source
        with raises(InvalidValueError, "cloud_extent"):
            generator.sample(1000.0 * CLOUD, 9, 3)
    finally:
        generator.close()


@needs("graspgenx")
def test_the_network_is_conditioned_on_the_z1_and_the_packages_are_restored(loaded):
    import os

    from models.nvidia.graspgenx import sweep_numbers

    sampler = loaded("graspgenx")._sampler
    with cuda_if_available():
        conditioning = sampler.load_gripper_input({})
    np.testing.assert_allclose(conditioning["sweep_volume_open_and_mid"], sweep_numbers(), atol=1e-6)
    assert conditioning["z_offset"].item() == pytest.approx(0.140)
    assert "GRASPGENX_GRIPPER_CFG_DIR" not in os.environ and "pointnet2_ops" not in sys.modules


@needs("graspgenx")
def test_a_network_with_an_unsupported_conditioning_is_rejected(tmp_path):
    from tests.support.nvidia_checkpoints import write_graspgenx

    folder = write_graspgenx(tmp_path / "points", gripper_backbone="pointnet_repr")
    with raises(GeneratorError, "unsupported_conditioning"):
        load_in_process("graspgenx", folder)


@needs("graspgenx")
def test_a_graspgenx_with_a_pointnet_encoder_runs_without_compiled_ops(tmp_path):
    from tests.support.nvidia_checkpoints import write_graspgenx

    folder = write_graspgenx(tmp_path / "pointnet", backbone="pointnet")
    assert len(load_in_process("graspgenx", folder).sample(CLOUD, 5, 0)) == 5


@needs("grasp_gen")
@pytest.mark.parametrize(
    ("damage", "code"),
    [
        (lambda c: c["diffusion"].update(gripper_name="franka_panda"), "checkpoint_unreadable"),
        (
            lambda c: [c[k].update(gripper_name="robotiq_2f_85") for k in ("data", "diffusion", "discriminator")],
            "unknown_gripper",
        ),
        (lambda c: c["eval"].update(model_name="m2t2"), "checkpoint_kind"),
        (lambda c: c["eval"].update(checkpoint="other.pth"), "checkpoint_missing"),
        (lambda c: c["diffusion"].update(diffusion_embed_dim=64), "checkpoint_unreadable"),
        (lambda c: c["discriminator"].update(checkpoint="text.pth"), "checkpoint_unreadable"),
        (lambda c: c.pop("diffusion"), "checkpoint_unreadable"),
    ],
)
def test_a_damaged_graspgen_checkpoint_is_rejected_with_its_name(damage, code, checkpoints, tmp_path):
    source = checkpoints("graspgen")
    for name in ("gen.pth", "dis.pth"):
        shutil.copy(source.with_name(name), tmp_path)
    (tmp_path / "text.pth").write_text("no checkpoint")
    config = yaml.safe_load(source.read_text())
    damage(config)
    path = tmp_path / "damaged.yml"
    path.write_text(yaml.safe_dump(config))
    with raises(GeneratorError, code) as caught:
        load_in_process("graspgen", path)
    assert "damaged.yml" in str(caught.value)


@needs("graspgenx")
def test_an_incomplete_graspgenx_release_is_rejected(checkpoints, tmp_path):
    shutil.copytree(checkpoints("graspgenx") / "gen", tmp_path / "gen")
    with raises(GeneratorError, "checkpoint_missing"):
        load_in_process("graspgenx", tmp_path)


@pytest.mark.parametrize(("name", "package"), [("graspgen", "grasp_gen"), ("graspgenx", "graspgenx")])
def test_a_missing_package_is_reported_with_its_installation(name, package, tmp_path):
    if importlib.util.find_spec(package) is not None:
        pytest.skip(f"{package} is installed")
    (tmp_path / "x.yml").write_text("{}")
    for part in ("gen", "dis"):
        (tmp_path / part).mkdir()
        (tmp_path / part / "config.yaml").write_text("{}")
    with raises(GeneratorError, "package_missing") as caught:
        load_in_process(name, tmp_path / "x.yml" if name == "graspgen" else tmp_path)
    assert f"--extra {name}" in str(caught.value)
