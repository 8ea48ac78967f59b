"""Denoiser and discriminator of grasps, which see the cloud in each grasp's own frame; and their weights on disk."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from models.weights_file import WEIGHTS_FOLDER, WeightsError, read_arrays, write_arrays

MAX_WIDTHS_M = MappingProxyType({"agnostic": 0.136, "z1": 0.080})
"""Widest object per gripper [m]: the opening of a Robotiq 2F-140 (its datasheet), the Z1's in the training data."""


POSITION_SCALE_M = 0.05  # positions, points and widths get values near 1 in the training data
CLOUD_SCALE_M = 0.06
WIDTH_MEAN_M, WIDTH_SCALE_M = 0.055, 0.03
N_COORDINATES = 10
_N_TOKENS = 48
_N_RELATIVE = 24
_QUERY, _VALUE = 16, 24  # channels of an attention head
_FIRST_TIME = 0.995  # at 1 the signal is zero and the step to the next time is not finite


def encode_grasps(T: Tensor, widths_m: Tensor) -> Tensor:
    """Return grasps (…, 4, 4) and widths (…) as coordinates (…, 10): position, approach, closing, width, all near 1."""
    width = (widths_m[..., None] - WIDTH_MEAN_M) / WIDTH_SCALE_M
    return torch.cat([T[..., :3, 3] / POSITION_SCALE_M, T[..., :3, 2], T[..., :3, 1], width], dim=-1)


def decode_grasps(v: Tensor) -> tuple[Tensor, Tensor]:
    """Return poses (…, 4, 4) and widths (…) [m] of coordinates (…, 10), their axes orthonormalised."""
    T = torch.zeros(*v.shape[:-1], 4, 4, dtype=v.dtype, device=v.device)
    T[..., :3, :3] = decode_rotations(v)
    T[..., :3, 3] = v[..., :3] * POSITION_SCALE_M
    T[..., 3, 3] = 1.0
    return T, v[..., 9] * WIDTH_SCALE_M + WIDTH_MEAN_M


def decode_rotations(v: Tensor) -> Tensor:
    """Return the rotations (…, 3, 3) of coordinates (…, 10): columns closing × approach, closing, approach."""
    z = F.normalize(v[..., 3:6], dim=-1, eps=1e-6)
    y = v[..., 6:9] - (v[..., 6:9] * z).sum(-1, keepdim=True) * z
    y = F.normalize(y, dim=-1, eps=1e-6)
    return torch.stack([torch.linalg.cross(y, z), y, z], dim=-1)


def alpha_bar(t: Tensor) -> Tensor:
    """Return ᾱ(t), t in [0, 1], of the cosine schedule (Nichol and Dhariwal 2021, eq. 17)."""
    return torch.cos((t + 0.008) / 1.008 * math.pi / 2.0) ** 2


def _fourier(x: Tensor, octaves: int = 4) -> Tensor:
    phase = (x[..., None] * (2.0 ** torch.arange(octaves, dtype=x.dtype, device=x.device) * math.pi / 2.0)).flatten(-2)
    return torch.cat([x, phase.sin(), phase.cos()], dim=-1)


def _mlp(*sizes: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for before, after in pairwise(sizes):
        layers += [nn.Linear(before, after), nn.SiLU()]
    return nn.Sequential(*layers)


class CloudEncoder(nn.Module):
    """PointNet with one pass of global context: a code of the whole cloud and one of each token point."""

    def __init__(self, code: int = 256, token: int = 128) -> None:
        super().__init__()
        self.local = _mlp(30, 96, 128)
        self.context = _mlp(256, 192, 192)
        self.code = _mlp(384, code, code)
        self.token = nn.Linear(192, token)

    def forward(self, cloud: Tensor) -> tuple[Tensor, Tensor]:
        """Return code (B, 256) and tokens (B, 48, 128) of clouds (B, N, 6), points [m] and normals."""
        x = self.local(torch.cat([_fourier(cloud[..., :3] / CLOUD_SCALE_M), cloud[..., 3:]], dim=-1))
        whole = x.amax(dim=1, keepdim=True)
        x = self.context(torch.cat([x, whole.expand_as(x)], dim=-1))
        code = self.code(torch.cat([x.amax(dim=1), x.mean(dim=1)], dim=-1))
        return code, self.token(x[:, :_N_TOKENS])


class _Block(nn.Module):
    """Attention from a grasp to the token points, biased by their positions in its frame; then a modulated MLP."""

    def __init__(self, width: int, condition: int, token: int, heads: int = 4) -> None:
        super().__init__()
        self.heads = heads
        self.norm_query = nn.LayerNorm(width)
        self.query = nn.Linear(width, heads * _QUERY)
        self.key = nn.Linear(token, heads * _QUERY)
        self.value = nn.Linear(token, heads * _VALUE)
        self.bias = nn.Linear(_N_RELATIVE, heads)
        self.out = nn.Linear(heads * (_VALUE + _N_RELATIVE), width)
        self.norm = nn.LayerNorm(width, elementwise_affine=False)
        self.modulate = nn.Linear(condition, 2 * width)
        self.mlp = nn.Sequential(nn.Linear(width, 2 * width), nn.SiLU(), nn.Linear(2 * width, width))
        nn.init.zeros_(self.out.weight)

    def forward(self, x: Tensor, condition: Tensor, tokens: Tensor, relative: Tensor) -> Tensor:
        """Return x (B, K, width) after attention to tokens (B, M, ·) with positions `relative` (B, K, M, 24)."""
        batch, count, _ = x.shape
        query = self.query(self.norm_query(x)).view(batch, count, self.heads, _QUERY).transpose(1, 2)
        key = self.key(tokens).view(batch, -1, self.heads, _QUERY).permute(0, 2, 3, 1)
        value = self.value(tokens).view(batch, -1, self.heads, _VALUE).transpose(1, 2)
        weights = query @ key / math.sqrt(_QUERY) + self.bias(relative).permute(0, 3, 1, 2)
        weights = weights.softmax(dim=-1)
        content = (weights @ value).transpose(1, 2)  # (B, K, H, 24)
        position = weights.transpose(1, 2) @ relative  # (B, K, H, M) @ (B, K, M, 24)
        x = x + self.out(torch.cat([content, position], dim=-1).flatten(2))
        scale, shift = self.modulate(condition).chunk(2, dim=-1)
        return x + self.mlp(self.norm(x) * (1.0 + scale) + shift)


class GraspHead(nn.Module):
    """Network from grasps and a cloud to outputs for each grasp."""

    def __init__(self, outputs: int, blocks: int, timed: bool, width: int = 192) -> None:
        super().__init__()
        self.enter = nn.Linear(9 * N_COORDINATES, width)
        self.relative = _mlp(12, 32, _N_RELATIVE)
        self.time = _mlp(64, 128, 128) if timed else None
        self.condition = _mlp(256 + (128 if timed else 0), 256)
        self.blocks = nn.ModuleList([_Block(width, 256, 128) for _ in range(blocks)])
        self.leave = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, outputs))

    def forward(self, v: Tensor, t: Tensor | None, code: Tensor, tokens: Tensor, cloud: Tensor) -> Tensor:
        """Return (B, K, outputs) for grasps v (B, K, 10) at times t (B, K or 1) among clouds (B, N, 6)."""
        with torch.autocast(v.device.type, enabled=False):  # bfloat16 at 5 cm resolves 0.2 mm
            local = _express_in_grasps(v.float(), cloud[:, :_N_TOKENS].float())
        relative = self.relative(local)
        condition = code[:, None]
        if self.time is not None and t is not None:
            rates = torch.exp(torch.linspace(0.0, math.log(1000.0), 32, device=t.device))
            phase = t[..., None] * rates
            time = self.time(torch.cat([phase.sin(), phase.cos()], dim=-1))
            condition = torch.cat([condition.expand(-1, time.shape[1], -1), time.to(code.dtype)], dim=-1)
        condition = self.condition(condition)
        x = self.enter(_fourier(v))
        for block in self.blocks:
            x = block(x, condition, tokens, relative)
        return self.leave(x)


def _express_in_grasps(v: Tensor, token_points: Tensor) -> Tensor:
    """Return token points (B, M, 6) and their normals in the frames of grasps (B, K, 10), as features (B, K, M, 12)."""
    batch, count, _ = v.shape
    R = decode_rotations(v)
    columns = R.permute(0, 2, 1, 3).reshape(batch, 3, count * 3)
    m = token_points.shape[1]

    def rotate(vectors: Tensor) -> Tensor:
        return (vectors @ columns).view(batch, m, count, 3).transpose(1, 2)

    origin = v[:, :, None, :3] @ R  # (B, K, 1, 3)
    r = rotate(token_points[..., :3] / POSITION_SCALE_M) - origin
    return torch.cat([r / 2.0, torch.tanh(1.5 * r), torch.tanh(5.0 * r), rotate(token_points[..., 3:])], dim=-1)


class Denoiser(nn.Module):
    """Grasp generator: v-prediction (Salimans and Ho 2022), sampled by DPM-Solver++(2M) (Lu et al. 2022)."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = CloudEncoder()
        self.head = GraspHead(N_COORDINATES, blocks=4, timed=True)

    def loss(self, cloud: Tensor, grasps: Tensor) -> Tensor:
        """Return the mean squared error of the predicted velocity for grasps (B, K, 10) of clouds (B, N, 6)."""
        code, tokens = self.encoder(cloud)
        t = torch.rand(grasps.shape[:2], device=grasps.device) * 0.999 + 0.0005
        signal = alpha_bar(t)[..., None]
        noise = torch.randn_like(grasps)
        noisy = signal.sqrt() * grasps + (1.0 - signal).sqrt() * noise
        velocity = signal.sqrt() * noise - (1.0 - signal).sqrt() * grasps
        return F.mse_loss(self.head(noisy, t, code, tokens, cloud).float(), velocity)

    @torch.inference_mode()
    def sample(self, cloud: Tensor, noise: Tensor, steps: int) -> Tensor:
        """Return grasps (B, K, 10) of clouds (B, N, 6), denoised from `noise` (B, K, 10).

        Each step uses the one before it, which reaches with 5 steps the quality of 8 first-order steps (DDIM).
        """
        code, tokens = self.encoder(cloud)
        x, before, stride_before = noise, None, 0.0
        times = torch.linspace(_FIRST_TIME, 0.0, steps + 1)
        for time, next_time in pairwise(times):
            signal, spread = _signal_and_spread(time)
            v = self.head(x, time.to(x.device).view(1, 1).expand(len(x), 1), code, tokens, cloud).float()
            clean = (signal * x - spread * v).clamp(-5.0, 5.0)
            if next_time == 0.0:
                return clean
            next_signal, next_spread = _signal_and_spread(next_time)
            stride = math.log(next_signal * spread / (next_spread * signal))  # of half the log signal-to-noise ratio
            ahead = clean if before is None else clean + 0.5 * stride / stride_before * (clean - before)
            x = next_spread / spread * x - next_signal * math.expm1(-stride) * ahead
            before, stride_before = clean, stride
        return x


def _signal_and_spread(time: Tensor) -> tuple[float, float]:
    """Return the weights of the grasp and of the noise at a time."""
    signal = float(alpha_bar(time.double()))
    return math.sqrt(signal), math.sqrt(1.0 - signal)


class Discriminator(nn.Module):
    """Scorer of grasps: the logit of the probability that a grasp holds."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = CloudEncoder()
        self.head = GraspHead(1, blocks=2, timed=False)

    def forward(self, cloud: Tensor, grasps: Tensor) -> Tensor:
        """Return logits (B, K) for grasps (B, K, 10) among clouds (B, N, 6)."""
        code, tokens = self.encoder(cloud)
        return self.head(grasps, None, code, tokens, cloud)[..., 0]


ModuleT = TypeVar("ModuleT", bound=nn.Module)


def weights_path(gripper: str = "agnostic") -> Path:
    """Return the path of the shipped weights for a gripper: `diffusion.npz`, or `diffusion_<gripper>.npz`."""
    return WEIGHTS_FOLDER / ("diffusion.npz" if gripper == "agnostic" else f"diffusion_{gripper}.npz")


def save_weights(path: Path, generator: Denoiser, discriminator: Discriminator) -> str:
    """Write both networks to `path` and their SHA-256 next to it; return the latter."""
    arrays = {f"generator/{k}": v for k, v in generator.state_dict().items()}
    arrays |= {f"discriminator/{k}": v for k, v in discriminator.state_dict().items()}
    return write_arrays(path, {k: v.numpy().astype(np.float16) for k, v in arrays.items()})


def load_weights(path: Path) -> tuple[Denoiser, Discriminator]:
    """Return the generator and the discriminator of the file at `path`, in evaluation mode.

    Raises:
        WeightsError: the file or its checksum is missing, they differ, or the file is of another network.
    """
    halves = read_arrays(path, "python -m scripts.train.train_diffusion")
    # Half precision is for the file alone: the parameters were trained in single
    arrays = {key: torch.from_numpy(value.astype(np.float32)) for key, value in halves.items()}
    return _fill(Denoiser(), "generator/", arrays, path), _fill(Discriminator(), "discriminator/", arrays, path)


def _fill(network: ModuleT, prefix: str, arrays: dict[str, torch.Tensor], path: Path) -> ModuleT:
    state = {key.removeprefix(prefix): value for key, value in arrays.items() if key.startswith(prefix)}
    try:
        network.load_state_dict(state)
    except RuntimeError as err:
        raise WeightsError(
            f"{path.name} holds another network than this version's: {err}", code="weights_other_network"
        ) from err
    return network.eval()
