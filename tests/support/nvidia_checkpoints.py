"""Small checkpoints of random numbers in the formats of GraspGen's and GraspGenX's trainings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
import yaml


def write_graspgen(folder: Path, *, gripper: str = "robotiq_2f_140", attention: str = "cat_attn") -> Path:
    """Write a GraspGen with a PointNet++ encoder, as the released Robotiq one has, and return its .yml."""
    from grasp_gen.models.discriminator import GraspGenDiscriminator
    from grasp_gen.models.generator import GraspGenGenerator
    from omegaconf import OmegaConf

    common = {
        "num_obs_dim": 64,
        "obs_backbone": "pointnet",
        "grasp_repr": "r3_so3",
        "ptv3": {"grid_size": 0.01},
        "gripper_name": gripper,
        "pose_repr": "mlp",
        "checkpoint_object_encoder_pretrained": None,
        "kappa": 2.022,
    }
    config = {
        "data": {"gripper_name": gripper, "num_points": 2000},
        "eval": {"model_name": "diffusion-discriminator", "checkpoint": "gen.pth"},
        "diffusion": common
        | {
            "num_embed_dim": 64,
            "diffusion_embed_dim": 32,
            "image_size": 256,
            "num_diffusion_iters": 10,
            "num_diffusion_iters_eval": 10,
            "compositional_schedular": True,
            "loss_pointmatching": False,
            "loss_l1_pos": True,
            "loss_l1_rot": True,
            "clip_sample": True,
            "beta_schedule": "squaredcos_cap_v2",
            "attention": attention,
            "num_grasps_per_object": 20,
        },
        "discriminator": common | {"topk_ratio": 0.75, "checkpoint": "dis.pth"},
    }
    folder.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(0)
    cfg = OmegaConf.create(config)
    _save(GraspGenGenerator.from_config(cfg.diffusion), folder / "gen.pth")
    _save(GraspGenDiscriminator.from_config(cfg.discriminator), folder / "dis.pth")
    path = folder / f"graspgen_{gripper}.yml"
    path.write_text(yaml.safe_dump(config))
    return path


def write_graspgenx(folder: Path, *, gripper_backbone: str = "sweep_volume_v2", backbone: str = "ptv3vanilla") -> Path:
    """Write a GraspGenX with its smallest point transformer (or PointNet++), and return the folder of gen/ and dis/."""
    from graspgenx.models.discriminator import GraspGenDiscriminator
    from graspgenx.models.generator import GraspGenGenerator
    from omegaconf import OmegaConf

    common: dict[str, Any] = {
        "num_object_dim": 512,
        "num_embed_dim": 512,
        "object_backbone": backbone,
        "gripper_backbone": gripper_backbone,
        "grasp_repr": "r3_so3",
        "ptv3": {"grid_size": 0.01},
        "pose_repr": "mlp",
        "checkpoint_object_encoder_pretrained": None,
        "kappa": 2.5,
        "pointnet_version": "v1",
        "ptv3vanilla": {
            "enc_depths": [1, 1, 1, 1, 1],
            "enc_channels": [16, 16, 32, 32, 64],
            "enc_num_head": [1, 1, 2, 2, 4],
            "enc_patch_size": [64, 64, 64, 64, 64],
        },
    }
    diffusion = common | {
        "diffusion_embed_dim": 64,
        "image_size": 256,
        "num_diffusion_iters": 10,
        "num_diffusion_iters_eval": 10,
        "compositional_schedular": True,
        "loss_pointmatching": False,
        "loss_l1_pos": True,
        "loss_l1_rot": True,
        "clip_sample": True,
        "beta_schedule": "squaredcos_cap_v2",
        "attention": "cat_attn",
        "num_grasps_per_object": 20,
    }
    config = {
        "data": {"num_points": 1024},
        "eval": {},
        "diffusion": diffusion,
        "discriminator": common | {"topk_ratio": 0.75},
    }
    torch.manual_seed(0)
    cfg = OmegaConf.create(config)
    networks = {"gen": (GraspGenGenerator, cfg.diffusion), "dis": (GraspGenDiscriminator, cfg.discriminator)}
    for part, (kind, settings) in networks.items():
        (folder / part).mkdir(parents=True)
        (folder / part / "config.yaml").write_text(yaml.safe_dump(config))
        _save(kind.from_config(settings), folder / part / "epoch_10.pth")
    return folder


def _save(network: torch.nn.Module, path: Path) -> None:
    torch.save({"model": network.state_dict(), "epoch": 10}, path)
