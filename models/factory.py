"""Grasp generators by name; what one needs is imported only when it is made."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from hal.base.errors import InvalidValueError
from models.types import GraspGenerator

GENERATORS = {
    "antipodal": "pairs of visible contacts that face each other; no learning",
    "obb_sweep": "sweeps over the faces of a box around the object; no learning",
    "diffusion": "the learned one, with the weights that ship: for any parallel jaw",
    "diffusion_z1": "the same for the Z1's own beak",
    "graspgen": "NVIDIA's GraspGen; checkpoints that you bring, non-commercial",
    "graspgenx": "NVIDIA's GraspGenX conditioned on the Z1's gripper; checkpoints that you bring",
}
"""Name to what it is."""
UNION = "union:"
"""`union:a+b` joins any of them, all scored by the learned discriminator."""
Process = Literal["in", "own"]
_TAKES_WEIGHTS = ("graspgen", "graspgenx")


@dataclass(frozen=True, slots=True, kw_only=True)
class GeneratorOptions:
    """What only some generators ask for."""

    weights: Path | None = None
    """Checkpoint of `graspgen` (the .yml) or `graspgenx` (the folder with gen/ and dis/), or a weights file (.npz) of
    `diffusion`. In a union it is for the one member that needs it."""
    process: Process = "in"
    """Where `graspgen` and `graspgenx` run: `in` this process, or in their `own`, with a Python of their own."""
    python: Path | None = None
    """The Python of that process; None takes what `python -m scripts.train.make_generator_env` made."""

    def __post_init__(self) -> None:
        if self.process not in get_args(Process):
            raise InvalidValueError(f"generator_process is {self.process!r}; allowed is in (this process) or own.")


def split_generator_name(name: str) -> tuple[str, ...]:
    """Return the members of a generator's name: one, or several of a `union:a+b`.

    Raises:
        ValueError: a member is not known, comes twice, or a union has fewer than two.
    """
    members = tuple(name.removeprefix(UNION).split("+")) if name.startswith(UNION) else (name,)
    for member in members:
        if member not in GENERATORS:
            known = ", ".join(GENERATORS)
            raise InvalidValueError(f"there is no generator {member!r}; known: {known}, or {UNION}a+b of any of them.")
    if name.startswith(UNION) and (len(members) < 2 or len(set(members)) < len(members)):
        raise InvalidValueError(
            f"{name!r} joins {len(set(members))} generator; a union has two or more different ones."
        )
    return members


def generator_for(weights: Path) -> str:
    """Return the name of the generator that weights such as these are for.

    Raises:
        ValueError: they are of none.
    """
    if weights.is_dir():
        return "graspgenx"
    known = {".yml": "graspgen", ".yaml": "graspgen", ".npz": "diffusion"}
    if weights.suffix not in known:
        raise InvalidValueError(
            f"no grasp generator has weights like {weights}; allowed is a .yml (GraspGen), a folder with gen/ and dis/ "
            "(GraspGenX), or an .npz of ours."
        )
    return known[weights.suffix]


def make_generator(name: str, options: GeneratorOptions | None = None) -> GraspGenerator:
    """Return the grasp generator called `name`.

    Raises:
        ValueError: no generator is called that, or its weights are missing or damaged.
        GeneratorError: what it runs on is missing, or its own process does not start.
    """
    options = options or GeneratorOptions()
    members = split_generator_name(name)
    weights_for = _who_takes_weights(members, options)
    made = [_make_one(member, options, options.weights if member == weights_for else None) for member in members]
    if len(made) == 1:
        return made[0]
    from models.samplers.union import UnionSampler

    return UnionSampler(made)


def _who_takes_weights(members: tuple[str, ...], options: GeneratorOptions) -> str | None:
    if options.weights is None:
        return None
    takers = [m for m in members if m in _TAKES_WEIGHTS] or [m for m in members if m == "diffusion"]
    if len(takers) != 1:
        takes = "takes no weights" if not takers else f"has {len(takers)} members that need weights of their own"
        raise InvalidValueError(f"{'+'.join(members)} {takes}, but --generator-weights is {options.weights}.")
    return takers[0]


def _make_one(name: str, options: GeneratorOptions, weights: Path | None) -> GraspGenerator:
    if name == "antipodal":
        from models.samplers.antipodal import AntipodalSampler

        return AntipodalSampler()
    if name == "obb_sweep":
        from models.samplers.obb_sweep import ObbSweepSampler

        return ObbSweepSampler()
    if name in ("diffusion", "diffusion_z1"):
        from models.diffusion.sampler import DiffusionConfig, DiffusionSampler
        from models.diffusion.training.labels import GRIPPERS

        gripper = "agnostic" if name == "diffusion" else "z1"
        width_m = GRIPPERS[gripper].max_width_m
        return DiffusionSampler(DiffusionConfig(gripper=gripper, weights=weights, max_width_m=width_m))
    from models.nvidia.nvidia import make_nvidia_generator

    return make_nvidia_generator(name, weights, own_process=options.process == "own", python=options.python)
