"""Run the paper's 81 scenarios in the twin: the same candidates for every method, one row per episode.

./z1 bench                                       # vanilla, mvb and full on all 81; some minutes on two cores
./z1 bench --methods full --objects box --seeds 0 1 2 --out out/boxes
./z1 bench --methods mvb mvb:k=3 mvb:alpha=0.5,box=upright --resume
./z1 bench --methods full --physics-noise --clutter 0 2 --top-k 3
./z1 bench --methods full --mesh drill.stl --scale 0.001 --mass 0.4
./z1 bench --seeds 0 1 2 3 4 --ray auto          # on the Ray cluster that this machine is part of

An exception in an episode becomes its row (mode `error`) with a traceback in errors.log, and the run goes on; the exit
code is then 1. --resume keeps such rows; to run these episodes again give another --out.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rich.console import Console
from rich.table import Table

from hal.base.errors import InvalidValueError
from hal.base.output_folder import open_output
from scripts.support.progress import make_progress

if TYPE_CHECKING:
    from sim_twin.benchmark.episodes.rows import Row
    from sim_twin.benchmark.episodes.runner import Task
    from sim_twin.benchmark.report.pictures import EpisodePicture
    from sim_twin.benchmark.results.store import Store
    from sim_twin.model.parts import GraspObject
    from z1_runtime.config import RuntimeConfig


@dataclass(frozen=True, kw_only=True)
class Config:
    """Options of the benchmark."""

    methods: tuple[str, ...] = ("vanilla", "mvb", "full")
    """Methods: vanilla, mvb and full; settings can be changed, as in `mvb:k=3,alpha=0.5,box=upright,hard_filter=no`."""
    set: Literal["paper", "extended"] = "paper"
    """Objects: the paper's in 27 poses each, or the extended set, upright, in 9."""
    objects: tuple[str, ...] = ()
    """Objects to run; by default all of the set."""
    mesh: Path | None = None
    """Your mesh (STL, OBJ, PLY, OFF, GLB; z up) instead of the set, in 27 poses; --objects adds others. It need not be
    watertight, but walls without thickness come out filled. A mesh that cannot stand is held as leaning objects are."""
    scale: float = 1.0
    """Metres in one unit of --mesh: 0.001 for a file in millimetres."""
    mass: float = 0.2
    """Mass of --mesh [kg]."""
    occlusion: tuple[float, ...] = (0.0,)
    """Ratios of the object's pixels that are occluded."""
    clutter: tuple[int, ...] = (0,)
    """Numbers of neighbours, 0 to 3, around the object; the detector selects the object by its class, or by the twin's
    ground truth if it knows no classes."""
    physics_noise: bool = False
    """Vary friction and mass by up to 30 %, the camera's pose by 3 mm and 1°, and the arm's latency up to 20 ms."""
    seeds: tuple[int, ...] = (0,)
    """Seeds: each runs all poses, with other noise and other candidates."""
    top_k: int = 1
    """Grasps that may be executed in an episode: after a failure the scene as it then is is captured again."""
    generator: str | None = None
    """Grasp generator; by default the configuration's."""
    detector: str | None = None
    """Detector; by default the configuration's. One that knows classes gets the class of each of the paper's objects;
    objects of unknown class are left to `tabletop`, unless the configuration names an object_class."""
    config: Path | None = None
    """A YAML file of settings (see `./z1 show-config`)."""
    jobs: int = 2
    """Worker processes."""
    ray: str | None = None
    """Address of a Ray cluster to run on instead: `auto`, HOST:6379 or ray://HOST:10001 (the extra `ray`)."""
    resume: bool = False
    """Continue an interrupted run in the same folder."""
    pictures: Literal["failures", "all", "none"] = "failures"
    """Final states to render into pictures/: up to 12 failures, which the report shows too, or all episodes."""
    recordings: Literal["shown", "failures", "all", "none"] = "shown"
    """Episodes to write into recordings/ for Rerun: first observation, ranking and plan; about 2 MB each. `shown`:
    those with a picture in the report."""
    out: Path = Path("out/bench")
    """Folder for episodes/, episodes.parquet, summary.json, report.html, errors.log, pictures/ and recordings/."""

    def __post_init__(self) -> None:
        if self.jobs < 1:
            raise InvalidValueError(
                f"bench: jobs is out of range ({self.jobs}, allowed 1 or more). Give --jobs 1 or more.",
                code="jobs_range",
            )
        if not 1 <= self.top_k <= 10:
            raise InvalidValueError(
                f"bench: top-k is out of range ({self.top_k}, allowed 1 to 10). Give --top-k 1 to 10.",
                code="top_k_range",
            )
        if self.ray is not None and self.recordings in ("failures", "all"):
            raise InvalidValueError(
                f"bench: --recordings {self.recordings} would leave files on the cluster's machines (allowed with "
                "--ray: shown and none). Give --recordings shown.",
                code="recordings_on_cluster",
            )


def main(config: Config) -> int:
    """Run the missing episodes, write the results, and return 1 if any episode ended in an exception, else 0."""
    with open_output(config.out):
        return _run_all(config)


def _run_all(config: Config) -> int:
    from hal.base.files import plain
    from sim_twin.benchmark.episodes.methods import parse_method
    from sim_twin.benchmark.episodes.runner import make_tasks
    from sim_twin.benchmark.episodes.scenarios import OBJECT_SETS, grid
    from sim_twin.benchmark.report.report import write_report
    from sim_twin.benchmark.results.store import Store
    from sim_twin.benchmark.results.summary import write_summary
    from z1_runtime.config import load_config

    methods = [parse_method(text) for text in config.methods]
    shapes = _load_shapes(config)
    objects = (*shapes, *config.objects) or OBJECT_SETS[config.set]
    scenarios = grid(
        objects, config.seeds, config.occlusion, config.clutter, physics_noise=config.physics_noise, shapes=shapes
    )
    changes = {"generator": config.generator, "detector": config.detector}
    runtime = replace(load_config(config.config), **{key: value for key, value in changes.items() if value})
    store = Store(config.out, config.resume)
    tasks = make_tasks(
        scenarios, methods, runtime, store.done(), top_k=config.top_k, recordings=_recordings_during_run(config)
    )
    console = Console(highlight=False)
    report = config.out / "report.html"
    rows, summary = [], {}
    try:
        _run(tasks, config, store, console)
    finally:  # also after Ctrl-C: the rows of finished episodes are kept
        rows = store.rows()
        if rows:
            store.write_table()
            run = {"version": version("z1-grasp"), "command": asdict(config), "settings": asdict(runtime)}
            summary = write_summary(rows, config.out / "summary.json", plain(run))
            write_report(rows, summary, report)
            _print_summary(console, summary)
    if pictures := _draw_pictures(rows, config, runtime, shapes):
        write_report(rows, summary, report, pictures)  # again, with links: the first one is there if drawing fails
    console.print(f"rows: {config.out}/episodes.parquet, figures: {config.out}/summary.json and report.html")
    return _exit_code(summary, config.out, console)


def _exit_code(summary: dict[str, Any], out: Path, console: Console) -> int:
    """Return 1 where an exception ended an episode, and print how many; else 0."""
    from sim_twin.benchmark.results.store import ERROR_LOG

    errors = sum(method["errors"] for method in summary.get("methods", {}).values())
    if errors:
        console.print(f"[red]{errors} episodes ended in an exception[/red]: tracebacks in {out / ERROR_LOG}")
    return int(errors > 0)


def _load_shapes(config: Config) -> dict[str, GraspObject]:
    """Return the object of the user's mesh by its name."""
    if config.mesh is None:
        return {}
    from sim_twin.model.mesh_objects import load_mesh_object

    name, shape = load_mesh_object(config.mesh, config.scale, config.mass)
    return {name: shape}


def _recordings_during_run(config: Config):
    """Return the recordings to make during the run; None for none."""
    from sim_twin.benchmark.episodes.recordings import Recordings

    if config.recordings not in ("failures", "all"):
        return None
    return Recordings(folder=config.out / "recordings", choice=config.recordings)


def _run(tasks: list[Task], config: Config, store: Store, console: Console) -> None:
    counts: dict[str, list[int]] = {}
    for row in store.rows(["success"]):
        _count(counts, row)
    with make_progress(console) as progress:
        bar = progress.add_task("", total=len(tasks))
        for rows in _rows_of(tasks, config):
            store.add(rows)
            for row in rows:
                _count(counts, row)
            progress.update(bar, advance=1, description="  ".join(f"{m} {s}/{n}" for m, (s, n) in counts.items()))


def _rows_of(tasks: list[Task], config: Config) -> Iterator[list[Row]]:
    from sim_twin.benchmark.episodes.cluster import run_tasks_on_ray
    from sim_twin.benchmark.episodes.runner import run_tasks

    if not tasks:
        return iter(())
    return run_tasks(tasks, config.jobs) if config.ray is None else run_tasks_on_ray(tasks, config.ray)


def _count(counts: dict[str, list[int]], row: Row) -> None:
    count = counts.setdefault(row["method"], [0, 0])
    count[0] += row["success"]
    count[1] += 1


def _draw_pictures(
    rows: list[Row], config: Config, runtime: RuntimeConfig, shapes: dict[str, GraspObject]
) -> list[EpisodePicture]:
    """Draw pictures and make their recordings; an episode run again for its recording is the same as before."""
    from sim_twin.benchmark.episodes.episode import record_scenario, recording_name
    from sim_twin.benchmark.episodes.methods import parse_method
    from sim_twin.benchmark.episodes.runner import make_grasp_selector
    from sim_twin.benchmark.episodes.scenarios import Scenario
    from sim_twin.benchmark.report.pictures import draw_pictures

    folder, pictures = config.out / "recordings", []
    for row, picture in draw_pictures(rows, config.pictures, config.out / "pictures", shapes):
        scenario, method = Scenario.from_row(row, shapes), parse_method(row["method"])
        path = folder / recording_name(scenario, method)
        if config.recordings == "shown" and not path.exists():
            record_scenario(scenario, method, lambda s, seed: make_grasp_selector(runtime, s, seed), folder)
        link = path.relative_to(config.out).as_posix() if path.exists() else ""
        pictures.append(replace(picture, recording=link))
    return pictures


def _print_summary(console: Console, summary: dict[str, Any]) -> None:
    table = Table("method", "episodes", "success", "95 %", "first-ranked only", "95 %", "how the others ended")
    for name, method in summary["methods"].items():
        modes = ", ".join(f"{mode} {n}" for mode, n in method["modes"].items() if mode != "success")
        table.add_row(
            name,
            str(method["episodes"]),
            f"{method['rate']:.1%}",
            _format_interval(method["rate_95"]),
            f"{method['rate_top1']:.1%}",
            _format_interval(method["rate_top1_95"]),
            modes,
        )
    console.print(table)
    for name, method in summary["methods"].items():
        if len(after := method["rate_after"]) > 1:
            console.print(f"{name}: " + ", ".join(f"{rate:.1%} within {k}" for k, rate in enumerate(after, 1)))
    for pair in summary["paired"]:
        first, second = pair["methods"]
        console.print(
            f"{pair['reading']}: only {first} {pair['only_first']}, only {second} {pair['only_second']} of "
            f"{pair['scenarios']}, {100 * pair['difference']:+.1f} points ({_format_points(pair['difference_95'])}), "
            f"McNemar p = {pair['p']:.2g}"
        )


def _format_points(interval: tuple[float, float]) -> str:
    return f"{100 * interval[0]:+.1f} to {100 * interval[1]:+.1f}"


def _format_interval(interval: tuple[float, float]) -> str:
    return f"{interval[0]:.1%} to {interval[1]:.1%}"
