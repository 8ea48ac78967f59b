"""Options of a pick that `./z1 demo` and `./z1 run` share."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from rich.console import Console

    from z1_runtime.config import RuntimeConfig
    from z1_runtime.tasks.pick import Phase


@dataclass(frozen=True, kw_only=True)
class PickOptions:
    """Configuration of a pick, with the settings that change most often as options."""

    calibration: Path | None = None
    """A hand-eye result; by default the newest of this camera (see `./z1 calibrate`), else the mount's drawing."""
    detector: str | None = None
    """Overrides the configuration: `tabletop`, `yolo`, or on the twin `ground_truth`, for evaluation."""
    detector_weights: Path | None = None
    """Weights for `yolo`, which they select: .npz of ours, .pt of ultralytics, .onnx, or OpenVINO's .xml or folder."""
    crop: Literal["mask", "box"] | None = None
    """Overrides the configuration: region cut out of the depth; `box` is the paper's."""
    generator: str | None = None
    """Overrides the configuration: the grasp generator, such as `diffusion` or `union:obb_sweep+diffusion`."""
    generator_weights: Path | None = None
    """Weights of the generator: GraspGen's .yml, GraspGenX's folder, or an .npz for `diffusion`."""
    config: Path | None = None
    """A YAML file of settings (see `./z1 show-config`)."""
    view: bool = False
    """Show the run live in Rerun."""

    def runtime_config(self) -> RuntimeConfig:
        """Return the configuration with the options applied.

        Raises:
            ConfigError: the file cannot be used.
            InvalidValueError: an option is out of its range.
        """
        from z1_runtime.config import load_config, with_detector, with_generator

        runtime = with_detector(load_config(self.config), self.detector, self.detector_weights, self.crop)
        return with_generator(runtime, self.generator, self.generator_weights)


def print_phase(console: Console, phase: Phase) -> None:
    """Print the name and duration of a finished phase."""
    console.print(f"  {phase.name:<9} {phase.duration_s:6.2f} s")
