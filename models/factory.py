"""Grasp generators by name, ours and installed ones; each imports its dependencies only when it is made."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Literal, get_args

from hal.base.errors import InvalidValueError
from models.types import GraspGenerator

GENERATORS = {
    "antipodal": "pairs of visible contacts that face each other; no learning",
    "obb_sweep": "sweeps over the faces of a box around the object; no learning",
    "diffusion": "the learned one, with the weights that ship: for any parallel gripper",
    "diffusion_z1": "the same for the Z1's own gripper",
    "graspgen": "NVIDIA's GraspGen; checkpoints that you bring, non-commercial",
    "graspgenx": "NVIDIA's GraspGenX conditioned on the Z1's gripper; checkpoints that you bring",
}
"""Names of this project's generators and their descriptions."""
ENTRY_POINTS = "z1_grasp.generators"
"""Group of entry points by which an installed package adds generators: name to a callable without arguments."""
UNION = "union:"
"""`union:a+b` joins any of them, all scored by the learned discriminator."""
Process = Literal["in", "own"]
_TAKES_WEIGHTS = ("graspgen", "graspgenx")


@dataclass(frozen=True, slots=True, kw_only=True)
class GeneratorOptions:
    """Options that only some generators use."""

    weights: Path | None = None
    """Checkpoint of `graspgen` (the .yml) or `graspgenx` (the folder with gen/ and dis/), or a weights file (.npz) of
    `diffusion`. In a union they go to the one member that needs them."""
    process: Process = "in"
    """Where `graspgen` and `graspgenx` run: `in` this process, or in their `own`, with a Python of their own."""
    python: Path | None = None
    """The Python of that process; None takes the one of `python -m scripts.train.make_generator_env`."""

    def __post_init__(self) -> None:
        if self.process not in get_args(Process):
            raise InvalidValueError(
                f"generator_options: process is {self.process!r}; allowed is in (this process) or own.",
                code="generator_process",
            )


@cache
def installed_generators() -> dict[str, EntryPoint]:
    """Return the generators that installed packages add, by name; they cannot replace this project's own."""
    return {entry.name: entry for entry in entry_points(group=ENTRY_POINTS) if entry.name not in GENERATORS}


def split_generator_name(name: str) -> tuple[str, ...]:
    """Return the members of a generator's name: one, or several for a `union:a+b`.

    Raises:
        InvalidValueError: a member is unknown or repeated, or a union has fewer than two.
    """
    members = tuple(name.removeprefix(UNION).split("+")) if name.startswith(UNION) else (name,)
    for member in members:
        if member not in GENERATORS and member not in installed_generators():
            known = ", ".join([*GENERATORS, *installed_generators()])
            raise InvalidValueError(
                f"there is no generator {member!r}; known: {known}, or {UNION}a+b of any of them.",
                code="unknown_generator",
            )
    if name.startswith(UNION) and (len(members) < 2 or len(set(members)) < len(members)):
        raise InvalidValueError(
            f"{name!r} joins {len(set(members))} generator; a union has two or more different ones.",
            code="union_members",
        )
    return members


def generator_for(weights: Path) -> str:
    """Return the name of the generator that reads weights of this kind.

    Raises:
        InvalidValueError: no generator does.
    """
    if weights.is_dir():
        return "graspgenx"
    known = {".yml": "graspgen", ".yaml": "graspgen", ".npz": "diffusion"}
    if weights.suffix not in known:
        raise InvalidValueError(
            f"no grasp generator has weights like {weights}; allowed is a .yml (GraspGen), a folder with gen/ and dis/ "
            "(GraspGenX), or an .npz of this project.",
            code="unknown_weights",
        )
    return known[weights.suffix]


def make_generator(name: str, options: GeneratorOptions | None = None) -> GraspGenerator:
    """Return the grasp generator called `name`.

    Raises:
        InvalidValueError: the name is unknown, or the weights do not fit it.
        WeightsError: the weights are missing or damaged.
        GeneratorError: a package is missing, or the generator's own process does not start.
    """
    options = options or GeneratorOptions()
    members = split_generator_name(name)
    weights_member = _find_weights_member(members, options)
    made = [_make_one(member, options, options.weights if member == weights_member else None) for member in members]
    if len(made) == 1:
        return made[0]
    from models.samplers.union import UnionSampler

    return UnionSampler(made)


def _find_weights_member(members: tuple[str, ...], options: GeneratorOptions) -> str | None:
    if options.weights is None:
        return None
    # NVIDIA's generators first: they have no weights of their own, `diffusion` ships with some
    takers = [m for m in members if m in _TAKES_WEIGHTS] or [m for m in members if m == "diffusion"]
    if len(takers) != 1:
        takes = "takes no weights" if not takers else f"has {len(takers)} members that need weights of their own"
        raise InvalidValueError(
            f"{'+'.join(members)} {takes}, but --generator-weights is {options.weights}.", code="generator_weights"
        )
    return takers[0]


def _make_one(name: str, options: GeneratorOptions, weights: Path | None) -> GraspGenerator:
    if name == "antipodal":
        from models.samplers.antipodal import AntipodalSampler

        return AntipodalSampler()
    if name == "obb_sweep":
        from models.samplers.obb_sweep import ObbSweepSampler

        return ObbSweepSampler()
    if name in ("diffusion", "diffusion_z1"):
        from models.diffusion.network import MAX_WIDTHS_M
        from models.diffusion.sampler import DiffusionConfig, DiffusionSampler

        gripper = "agnostic" if name == "diffusion" else "z1"
        return DiffusionSampler(DiffusionConfig(gripper=gripper, weights=weights, max_width_m=MAX_WIDTHS_M[gripper]))
    if name in installed_generators():
        return installed_generators()[name].load()()
    from models.nvidia.nvidia import make_nvidia_generator

    return make_nvidia_generator(name, weights, own_process=options.process == "own", python=options.python)
