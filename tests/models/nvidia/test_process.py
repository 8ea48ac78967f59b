"""A generator in its own process: its replies, and every failure of them."""

from __future__ import annotations

import io
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from hal.base.errors import InvalidValueError
from models.nvidia.errors import GeneratorError
from models.nvidia.pipe import PipeError, read_message, write_message
from models.nvidia.process import WORKER, ProcessGenerator
from tests.support.errors import raises

PYTHON = Path(sys.executable)
CLOUD = np.random.default_rng(0).uniform([-0.03, -0.05, 0.38], [0.03, 0.05, 0.42], (200, 3))
HEAD = f"""
import importlib.util, os, sys
spec = importlib.util.spec_from_file_location("pipe", {str(WORKER.with_name("pipe.py"))!r})
pipe = importlib.util.module_from_spec(spec)
spec.loader.exec_module(pipe)
import numpy as np
out = sys.stdout.buffer
"""
READY = 'pipe.write_message(out, {"protocol": pipe.PROTOCOL, "python": "3"})\n'
SERVE = """
while (r := pipe.read_message(sys.stdin.buffer)) is not None:
    n = int(r["n"])
    if r["seed"] == 1: os._exit(7)
    if r["seed"] == 2: print("out of memory", file=sys.stderr); sys.exit(3)
    if r["seed"] == 3: import threading; threading.Event().wait()
    if r["seed"] == 4: out.write(b"hello there, this is no message"); out.flush(); continue
    if r["seed"] == 5: pipe.write_message(out, {"error": "too flat", "kind": "ValueError", "code": "x"}); continue
    if r["seed"] == 6: pipe.write_message(out, {"error": "oh", "kind": "IndexError", "code": "y"}); continue
    if r["seed"] == 7: pipe.write_message(out, {"scores": np.zeros(2)}); continue
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, :3, 3] = r["points"].mean(axis=0)
    pipe.write_message(out, {"T_camera_grasps": T, "scores": np.ones(n), "widths_m": np.full(n, np.nan),
                             "source": f"fake {sys.argv[1:]} {os.getpid()}"})
"""


def make(tmp_path: Path, body: str, **options: float) -> ProcessGenerator:
    worker = tmp_path / "worker.py"
    worker.write_text(HEAD + body)
    return ProcessGenerator("fake", tmp_path / "weights.yml", PYTHON, worker=worker, **options)


@pytest.fixture
def served(tmp_path):
    generator = make(tmp_path, READY + SERVE, timeout_s=20.0)
    yield generator
    generator.close()


def test_grasps_cross_the_pipe_unchanged(served, tmp_path):
    grasps = served.sample(CLOUD, 7, 0)
    assert len(grasps) == 7 and np.isnan(grasps.widths_m).all()
    np.testing.assert_array_equal(grasps.T_camera_grasps[3, :3, 3], CLOUD.mean(axis=0))
    assert grasps.source.startswith(f"fake ['fake', '{tmp_path}/weights.yml']")


@pytest.mark.integration
def test_one_process_serves_many_requests_until_close_and_a_new_one_after(served):
    first, again = served.sample(CLOUD, 1, 0).source, served.sample(CLOUD, 1, 0).source
    assert first == again
    served.close()
    assert served.sample(CLOUD, 1, 0).source != first


def test_a_bad_cloud_is_rejected_before_the_pipe(served):
    with raises(InvalidValueError, "cloud_extent"):
        served.sample(1000.0 * CLOUD, 1, 1)  # seed 1 would have ended it
    assert len(served.sample(CLOUD, 1, 0)) == 1


@pytest.mark.integration
@pytest.mark.parametrize(
    ("seed", "error", "code"),
    [
        (1, GeneratorError, "process_ended"),
        (2, GeneratorError, "process_ended"),
        (4, GeneratorError, "message_length"),
        (5, InvalidValueError, "x"),
        (6, GeneratorError, "y"),
        (7, GeneratorError, "bad_output"),
    ],
)
def test_each_failure_is_reported_and_the_next_request_is_served(served, seed, error, code):
    with raises(error, code) as caught:
        served.sample(CLOUD, 1, seed)
    if seed == 2:
        assert "ended with code 3.\n    out of memory" in str(caught.value)
    assert len(served.sample(CLOUD, 4, 0)) == 4


@pytest.mark.integration
def test_a_process_that_hangs_is_ended_after_the_timeout(tmp_path):
    generator = make(tmp_path, READY + SERVE, timeout_s=0.5)
    with raises(GeneratorError, "process_timeout"):
        generator.sample(CLOUD, 1, 3)


@pytest.mark.integration
def test_ctrl_c_while_waiting_ends_the_process(tmp_path, monkeypatch):
    generator = make(tmp_path, READY + SERVE)
    child = generator._child
    assert child is not None

    def interrupt(timeout: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(child, "_replies", SimpleNamespace(get=interrupt))
    with pytest.raises(KeyboardInterrupt):
        generator.sample(CLOUD, 1, 3)
    assert child._process.returncode is not None
    assert len(generator.sample(CLOUD, 1, 0)) == 1


@pytest.mark.integration
def test_a_failed_start_is_reported_with_the_last_lines_of_stderr(tmp_path):
    with raises(GeneratorError, "process_ended") as caught:
        make(tmp_path, "import grasp_gem")
    assert "No module named 'grasp_gem'" in str(caught.value)
    with raises(GeneratorError, "process_timeout"):
        make(tmp_path, "import threading; threading.Event().wait()", start_timeout_s=0.5)
    with raises(GeneratorError, "process_start"):
        ProcessGenerator("fake", tmp_path, tmp_path / "python")


@pytest.mark.integration
def test_another_protocol_version_is_rejected(tmp_path):
    with raises(GeneratorError, "protocol_version"):
        make(tmp_path, 'pipe.write_message(out, {"protocol": 99})')


@pytest.mark.integration
def test_the_process_ends_when_the_generator_is_collected(tmp_path):
    generator = make(tmp_path, READY + SERVE)
    child = generator._child
    assert child is not None
    process = child._process
    del generator, child
    assert process.wait(20.0) == 0


@pytest.mark.parametrize("name", ["graspgen", "graspgenx"])
def test_the_worker_imports_nothing_but_numpy_and_the_light_part_of_this_project(name):
    code = (
        f"import sys, runpy; sys.argv = ['w', {name!r}, 'none']\n"
        f"try: runpy.run_path({str(WORKER)!r}, run_name='__main__')\n"
        "except SystemExit as end:\n"
        "    heavy = [m for m in ('numba', 'scipy', 'pinocchio', 'torch', 'z1_runtime') if m in sys.modules]\n"
        "    hal = sorted(m for m in sys.modules if m.startswith('hal.base.'))\n"
        "    print(heavy, hal, end.code, file=sys.stderr)"
    )
    done = subprocess.run([PYTHON, "-I", "-c", code], capture_output=True, check=True, stdin=subprocess.DEVNULL)
    reply = read_message(io.BytesIO(done.stdout))
    assert reply is not None and str(reply["code"]) == "checkpoint_missing"
    facts = ["hal.base.z1"] if name == "graspgenx" else []
    assert done.stderr.decode().strip().splitlines()[-1] == f"[] {['hal.base.errors', *facts]} 1"


@pytest.mark.integration
def test_the_real_worker_reports_a_missing_checkpoint(tmp_path):
    with raises(GeneratorError, "checkpoint_missing"):
        ProcessGenerator("graspgen", tmp_path / "none.yml", PYTHON)


def test_messages_that_are_cut_too_long_or_without_arrays_are_rejected():
    whole = io.BytesIO()
    write_message(whole, {"a": np.arange(3), "b": "words"})
    data = whole.getvalue()
    message = read_message(io.BytesIO(data))
    assert message is not None and message["a"].tolist() == [0, 1, 2] and str(message["b"]) == "words"
    assert read_message(io.BytesIO(b"")) is None
    for cut in (data[:5], data[:-1]):
        with raises(PipeError, "message_cut"):
            read_message(io.BytesIO(cut))
    with raises(PipeError, "message_length"):
        read_message(io.BytesIO(b"\xff" * 20))
    with raises(PipeError, "message_not_arrays"):
        read_message(io.BytesIO(data[:8] + b"x" * (len(data) - 8)))
    with pytest.raises(ValueError):
        write_message(io.BytesIO(), {"a": np.array([{}], dtype=object)})
