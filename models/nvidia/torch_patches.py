"""Patches that let networks written for CUDA run without it, with their source unchanged."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from models.nvidia import pointnet_ops

_PATCHING = threading.RLock()


@contextmanager
def cuda_if_available() -> Iterator[None]:
    """Turn `.cuda()` of tensors and networks into a no-operation within, if this machine has no CUDA.

    Elsewhere in the process such a call could only raise, so no other code changes its behaviour.
    """
    if torch.cuda.is_available():
        yield
        return
    # The patch is global: a second thread would keep the patched method as the original
    with _PATCHING:
        owners: tuple[Any, ...] = (Tensor, nn.Module)
        kept = [owner.cuda for owner in owners]
        for owner in owners:
            owner.cuda = _keep_device
        try:
            yield
        finally:
            for owner, method in zip(owners, kept, strict=True):
                owner.cuda = method


def _keep_device(self: Any, *_: Any, **__: Any) -> Any:
    return self


@contextmanager
def seed_random_numbers(seed: int) -> Iterator[None]:
    """Seed the global random numbers of torch and NumPy within; afterwards they continue as before."""
    state = np.random.get_state()
    try:
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            # NumPy's legacy generator takes 32 bits
            np.random.seed(seed % 2**32)
            yield
    finally:
        np.random.set_state(state)


@contextmanager
def replace_compiled_ops() -> Iterator[None]:
    """Replace the package `pointnet2_ops` by our operations within; it is neither compiled nor required."""
    replacement: Any = ModuleType("pointnet2_ops")
    replacement._ext = pointnet_ops
    before = sys.modules.get("pointnet2_ops")
    sys.modules["pointnet2_ops"] = replacement
    try:
        yield
    finally:
        if before is None:
            del sys.modules["pointnet2_ops"]
        else:
            sys.modules["pointnet2_ops"] = before


class _FoldedAttention(nn.Module):
    """Attention over a sequence of one: its softmax is 1, so its output is a linear map of the value."""

    def __init__(self, attention: nn.MultiheadAttention) -> None:
        super().__init__()
        dim = attention.embed_dim
        weight, bias = attention.in_proj_weight, attention.in_proj_bias
        out = attention.out_proj
        with torch.no_grad():
            # In double precision, so that folding adds no rounding of its own
            W_out = out.weight.double()
            self.linear = nn.Linear(dim, dim, device=out.weight.device, dtype=out.weight.dtype)
            # The projection holds queries, keys and values, in this order
            self.linear.weight.copy_(W_out @ weight[2 * dim :].double())
            self.linear.bias.copy_(W_out @ bias[2 * dim :].double() + out.bias.double())

    def forward(
        self, query: Tensor, key: Tensor, value: Tensor, attn_mask: Tensor | None = None
    ) -> tuple[Tensor, None]:
        if len(value) != 1 or attn_mask is not None:
            raise RuntimeError(f"attention over {len(value)} tokens is not the linear map it was folded into.")
        return self.linear(value), None


def fold_attention(network: nn.Module) -> int:
    """Replace every attention in `network`, which always gets one token, by its linear map; return their number.

    The result is the same but for rounding. A third of the weights is read, and memory is the limit on a CPU.
    """
    folded = 0
    for parent in list(network.modules()):
        for name, child in list(parent.named_children()):
            if isinstance(child, nn.MultiheadAttention) and _is_plain(child):
                setattr(parent, name, _FoldedAttention(child).eval())
                folded += 1
    return folded


def _is_plain(attention: nn.MultiheadAttention) -> bool:
    """Return whether queries, keys and values are as wide as the network and nothing is added to the sequence."""
    return (
        attention.in_proj_weight is not None
        and attention.in_proj_bias is not None
        and attention.bias_k is None
        and not attention.add_zero_attn
        and not attention.batch_first
    )
