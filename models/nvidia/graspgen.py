"""NVIDIA's GraspGen as a `GraspGenerator`, with a checkpoint that the user brings.

GraspGen's code and its released checkpoints are under NVIDIA's licence: research and evaluation, no commercial use.
Nothing of it is copied here: the code comes with the package `eden-grasp-gen`, the checkpoint from the user.
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
def log_licence_once() -> None:
    """Log the licence's conditions, the first time."""
    _LOG.warning(
        "GraspGen, its code (eden-grasp-gen) and its checkpoints, is NVIDIA's and for research and evaluation only: "
        "no commercial use."
    )


def load(config: Path) -> GraspGenerator:
    """Return GraspGen with the checkpoint whose `config` (.yml) names two .pth files in its folder.

    Raises:
        GeneratorError: the package or a file is missing, or the files are of another kind.
    """
    if config.suffix not in (".yml", ".yaml") or not config.is_file():
        raise GeneratorError(
            f"{config} is missing, or no .yml; name the one of a GraspGen checkpoint.", code="checkpoint_missing"
        )
    require_package("grasp_gen", "graspgen")
    log_licence_once()
    from grasp_gen.grasp_server import GraspGenSampler, load_grasp_cfg  # pyright: ignore[reportMissingImports]
    from grasp_gen.models.pointnet import pointnet2_utils  # pyright: ignore[reportMissingImports]

    from models.nvidia import pointnet_ops
    from models.nvidia.torch_patches import cuda_if_available, fold_attention

    logging.getLogger("grasp_gen").setLevel(logging.WARNING)  # it logs every step to stdout
    cfg = load_guarded(str(config), lambda: load_grasp_cfg(str(config)))
    gripper = load_guarded(str(config), lambda: _check(cfg, config))
    pointnet2_utils._OPS = pointnet_ops  # in place of those that it compiles for CUDA on first use
    with cuda_if_available():
        sampler = load_guarded(str(config), lambda: GraspGenSampler(cfg))
    fold_attention(sampler.model.grasp_generator.diffusion_head)
    T_base_tip = sampler.model.grasp_generator.gripper_info.transform_from_base_link_to_tool_tcp
    return NvidiaSampler(sampler, T_base_tip, f"graspgen-{gripper}")


def _check(cfg: Any, config: Path) -> str:
    """Return the gripper's name from a configuration of GraspGen whose files exist.

    Raises:
        GeneratorError: the configuration is of another kind, or a file is missing.
    """
    import grasp_gen  # pyright: ignore[reportMissingImports]

    gripper = str(cfg.data.gripper_name)
    if cfg.eval.model_name != "diffusion-discriminator":
        raise GeneratorError(
            f"it is of the model {cfg.eval.model_name!r}; allowed is diffusion-discriminator.", code="checkpoint_kind"
        )
    for checkpoint in (cfg.eval.checkpoint, cfg.discriminator.checkpoint):
        if not Path(checkpoint).is_file():
            raise GeneratorError(
                f"{checkpoint}, which it names, is missing; put it into the folder of {config.name}.",
                code="checkpoint_missing",
            )
    grippers = Path(str(grasp_gen.__file__)).parent / "config" / "grippers"
    known = sorted(path.stem for path in grippers.glob("*.yaml") if path.with_suffix(".py").is_file())
    known = [name for name in known if "suction" not in name]
    if gripper not in known:
        raise GeneratorError(
            f"its gripper is {gripper!r}; grippers that eden-grasp-gen describes: {', '.join(known)}.",
            code="unknown_gripper",
        )
    return gripper
