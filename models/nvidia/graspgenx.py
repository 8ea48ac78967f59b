"""NVIDIA's GraspGenX as a `GraspGenerator`, conditioned on the Z1's gripper.

Its code (the package `eden-graspgenx`) is under Apache-2.0, its released weights under the NVIDIA Open Model License:
read that before shipping anything made with them.
"""

from __future__ import annotations

import io
import json
import logging
import math
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from hal.base.z1 import (
    JAW_REACH_M,
    KNEE_RADIUS_M,
    PAD_HALF_WIDTH_M,
    PALM_HALF_WIDTH_M,
    PALM_RADIUS_M,
    T_PIVOT_STATIONARY_JAW,
)
from models.nvidia.errors import GeneratorError
from models.nvidia.nvidia import NvidiaSampler, load_guarded, require_package
from models.types import GraspGenerator

_LOG = logging.getLogger(__name__)

_WIDEST_M = 0.065
"""Widest object that the Z1 gripper is opened for [m]."""
_BODY_HALF_M = 0.05  # half the size of the bounding box along the closing axis


def _make_sweep_box(jaw_rad: float) -> tuple[list[float], list[float]]:
    """Return extents and centre of the volume between both jaws at an opening, rounded to millimetres [m]."""
    axis = -float(T_PIVOT_STATIONARY_JAW[0, 3])
    width = round(2.0 * KNEE_RADIUS_M * math.sin(jaw_rad / 2.0), 3)
    palm, tips = axis + PALM_RADIUS_M, round(axis + JAW_REACH_M * math.cos(jaw_rad / 2.0), 3)
    return [width, 2.0 * PAD_HALF_WIDTH_M, round(tips - palm, 3)], [0.0, 0.0, round((tips + palm) / 2.0, 3)]


def _describe_z1() -> dict[str, Any]:
    # The opening at which the knees are that far apart, a chord of the circle about the axis
    jaw_rad = 2.0 * math.asin(_WIDEST_M / 2.0 / KNEE_RADIUS_M)
    (extents, offset), (half_extents, half_offset) = _make_sweep_box(jaw_rad), _make_sweep_box(jaw_rad / 2.0)
    tips = offset[2] + extents[2] / 2.0
    reach = JAW_REACH_M - float(T_PIVOT_STATIONARY_JAW[0, 3])
    return {
        "open": {"jointGripper": -round(jaw_rad, 2)},
        "close": {"jointGripper": 0.0},
        "fingertip": [0.0, 0.0, round(tips, 3)],
        "sweep_volume": {"extents": extents, "offset": offset, "extents2": half_extents, "offset2": half_offset},
        "standoff": [0.0, 0.03],
        "bbox": [[-_BODY_HALF_M, -PALM_HALF_WIDTH_M, 0.0], [_BODY_HALF_M, PALM_HALF_WIDTH_M, round(reach, 3)]],
        "symmetric": False,
        "type": "revolute_2f",
    }


Z1_GRIPPER = _describe_z1()
"""The Z1's gripper in GraspGenX's format (`config.json`): z approach, x closing, origin at GripperStator [m].

The runtime fits the gripper so that both jaws lean alike on an object, hence a box symmetric in x: as wide as the knees
are apart at the opening for the widest object, and at half of it; from the palm to the leaning fingertips. Boston
Dynamics' Spot, the other gripper with one moving jaw in GraspGenX's collection, is described likewise.
"""
_NAME = "unitree_z1"
_BOX_CONDITIONINGS = (
    "none",
    "z_offset",
    "gripper_type",
    "sweep_volume",
    "sweep_volume_v2",
    "gripper_type+sweep_volume_v2",
)


@cache
def log_licence_once() -> None:
    """Log the licence's conditions, the first time."""
    _LOG.info("GraspGenX's weights are under the NVIDIA Open Model License; its code is Apache-2.0.")


def load(folder: Path) -> GraspGenerator:
    """Return GraspGenX with the checkpoints in `folder`: gen/ and dis/, each with a config.yaml and a .pth.

    Raises:
        GeneratorError: the package or a file is missing, or the files are of another kind.
    """
    for needed in (folder / part / "config.yaml" for part in ("gen", "dis")):
        if not needed.is_file():
            raise GeneratorError(
                f"{needed} is missing; name the folder of a GraspGenX release, with gen/ and dis/.",
                code="checkpoint_missing",
            )
    require_package("graspgenx", "graspgenx")
    log_licence_once()
    from models.nvidia import pointnet_ops
    from models.nvidia.torch_patches import cuda_if_available, fold_attention, replace_compiled_ops

    with replace_compiled_ops():  # GraspGenX compiles them at import
        from graspgenx.grasp_server import GraspGenXSampler  # pyright: ignore[reportMissingImports]
        from graspgenx.models.pointnet import pointnet2_utils  # pyright: ignore[reportMissingImports]
        from graspgenx.utils.checkpoint_io import load_model_cfg  # pyright: ignore[reportMissingImports]
    pointnet2_utils.ops = pointnet_ops
    with _log_prints(), _z1_assets() as assets, cuda_if_available():
        cfg = load_guarded(str(folder), lambda: load_model_cfg(str(folder / "gen"), str(folder / "dis")))
        load_guarded(str(folder), lambda: _check_backbones(cfg))
        sampler = load_guarded(str(folder), lambda: GraspGenXSampler(cfg, _NAME, str(assets)))
    fold_attention(sampler.model.grasp_generator.diffusion_head)
    conditioning = np.concatenate([sampler.gripper.sweep_volume, sampler.gripper.sweep_volume_mid])
    if not np.allclose(conditioning, sweep_numbers()):
        raise GeneratorError(
            f"GraspGenX read another gripper than the Z1's: {conditioning}, not {sweep_numbers()}.",
            code="unknown_gripper",
        )
    return NvidiaSampler(sampler, sampler.gripper.tool_tcp_transform, f"graspgenx-{_NAME}")


def sweep_numbers() -> np.ndarray:
    """Return the conditioning (12,) of the network: extents and offset, open and half open [m]."""
    volume = Z1_GRIPPER["sweep_volume"]
    return np.concatenate([volume[key] for key in ("extents", "offset", "extents2", "offset2")])


def _check_backbones(cfg: Any) -> None:
    """Check that the networks need nothing of a gripper beyond the Z1's description.

    Raises:
        GeneratorError: they need point clouds or volumes, which GraspGenX would replace by zeros.
    """
    for network in ("diffusion", "discriminator"):
        backbone = cfg[network].gripper_backbone
        if backbone not in _BOX_CONDITIONINGS:
            raise GeneratorError(
                f"its {network} is conditioned on the gripper's {backbone!r}, which the Z1's description does not "
                f"hold; allowed is {', '.join(_BOX_CONDITIONINGS)}.",
                code="unsupported_conditioning",
            )


@contextmanager
def _z1_assets() -> Iterator[Path]:
    """Yield a folder with the Z1's gripper for GraspGenX, which within searches no other and downloads nothing."""
    variable = "GRASPGENX_GRIPPER_CFG_DIR"
    before = os.environ.get(variable)
    with tempfile.TemporaryDirectory(prefix="z1-gripper-") as name:
        folder = Path(name) / "x_grippers" / _NAME
        folder.mkdir(parents=True)
        (folder / "config.json").write_text(json.dumps(Z1_GRIPPER))
        os.environ[variable] = name
        try:
            yield Path(name)
        finally:
            if before is None:
                del os.environ[variable]
            else:
                os.environ[variable] = before


@contextmanager
def _log_prints() -> Iterator[None]:
    """Redirect prints to the log within: among them are warnings about files that the Z1 does not need."""
    printed = io.StringIO()
    try:
        with redirect_stdout(printed):
            yield
    finally:
        _LOG.debug("GraspGenX printed: %s", printed.getvalue())
