"""NVIDIA's GraspGen behind the house's contract, with a checkpoint that the user brings.

GraspGen's code and its released checkpoints are under NVIDIA's licence: research and evaluation, no commercial use.
Nothing of theirs is copied here; the package `eden-grasp-gen` brings the code, and the user the checkpoint.
"""

from __future__ import annotations

import logging
from functools import cache
from pathlib import Path
from typing import Any

from models.nvidia.errors import GeneratorError
from models.nvidia.nvidia import NvidiaSampler, load_guarded, require_package
from models.types import GraspGenerator

_LOG = logging.getLogger(__name__)


@cache
def say_licence_once() -> None:
    """Say what the licence asks, the first time."""
    _LOG.warning(
        "GraspGen, its code (eden-grasp-gen) and its checkpoints, is NVIDIA's and for research and evaluation only: "
        "no commercial use."
    )


def load(config: Path) -> GraspGenerator:
    """Return GraspGen with the checkpoint whose `config` (.yml) names two .pth files beside itself.

    Raises:
        GeneratorError: the package is missing, or the files are, or they are of something else.
    """
    if config.suffix not in (".yml", ".yaml") or not config.is_file():
        raise GeneratorError(f"{config} is not there, or no .yml; name the one of a GraspGen checkpoint.")
    require_package("grasp_gen", "graspgen")
    say_licence_once()
    from grasp_gen.grasp_server import GraspGenSampler, load_grasp_cfg  # pyright: ignore[reportMissingImports]
    from grasp_gen.models.pointnet import pointnet2_utils  # pyright: ignore[reportMissingImports]

    from models.nvidia import pointnet_ops
    from models.nvidia.torch_patches import cuda_only_if_there, fold_attention

    logging.getLogger("grasp_gen").setLevel(logging.WARNING)  # it prints every step to stdout
    cfg = load_guarded(str(config), lambda: load_grasp_cfg(str(config)))
    gripper = load_guarded(str(config), lambda: _check(cfg, config))
    pointnet2_utils._OPS = pointnet_ops  # what they compile for CUDA on first use
    with cuda_only_if_there():
        sampler = load_guarded(str(config), lambda: GraspGenSampler(cfg))
    fold_attention(sampler.model.grasp_generator.diffusion_head)
    T_base_tip = sampler.model.grasp_generator.gripper_info.transform_from_base_link_to_tool_tcp
    return NvidiaSampler(sampler, T_base_tip, f"graspgen-{gripper}")


def _check(cfg: Any, config: Path) -> str:
    """Return the name of the gripper of a configuration that is a GraspGen's and whose files are there.

    Raises:
        GeneratorError: it is not, or they are not.
    """
    import grasp_gen  # pyright: ignore[reportMissingImports]

    gripper = str(cfg.data.gripper_name)
    if cfg.eval.model_name != "diffusion-discriminator":
        raise GeneratorError(f"it is of the model {cfg.eval.model_name!r}; allowed is diffusion-discriminator.")
    for checkpoint in (cfg.eval.checkpoint, cfg.discriminator.checkpoint):
        if not Path(checkpoint).is_file():
            raise GeneratorError(f"{checkpoint}, which it names, is missing; it belongs beside {config.name}.")
    grippers = Path(str(grasp_gen.__file__)).parent / "config" / "grippers"
    known = sorted(path.stem for path in grippers.glob("*.yaml") if path.with_suffix(".py").is_file())
    known = [name for name in known if "suction" not in name]
    if gripper not in known:
        raise GeneratorError(f"its gripper is {gripper!r}; jaws that eden-grasp-gen describes: {', '.join(known)}.")
    return gripper
