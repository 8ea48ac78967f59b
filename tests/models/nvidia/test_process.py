"""A generator in its own process: what it answers, and every way in which it can fail to."""

from __future__ import annotations

import io
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from models.nvidia.errors import GeneratorError
from models.nvidia.pipe import PipeError, read_message, write_message
from models.nvidia.process import WORKER, ProcessGenerator

PYTHON = Path(sys.executable)
CLOUD = np.random.default_rng(0).uniform([-0.03, -0.05, 0.38], [0.03, 0.05, 0.42], (200, 3))
HEAD = f"""
import importlib.util, os, sys
spec = importlib.util.spec_from_file_location("wire", {str(WORKER.with_name("wire.py"))!r})
wire = importlib.util.module_from_spec(spec)
spec.loader.exec_module(wire)
import numpy as np
out = sys.stdout.buffer
"""
READY = 'wire.write_message(out, {"protocol": wire.PROTOCOL, "python": "3"})\n'
SERVE = """
while (r := wire.read_message(sys.stdin.buffer)) is not None:
    n = int(r["n"])
    if r["seed"] == 1: os._exit(7)
    if r["seed"] == 2: print("out of memory", file=sys.stderr); sys.exit(3)
    if r["seed"] == 3: import threading; threading.Event().wait()
    if r["seed"] == 4: out.write(b"hello there, this is no message"); out.flush(); continue
    if r["seed"] == 5: wire.write_message(out, {"error": "too flat", "kind": "ValueError"}); continue
    if r["seed"] == 6: wire.write_message(out, {"error": "oh", "kind": "IndexError"}); continue
    if r["seed"] == 7: wire.write_message(out, {"scores": np.zeros(2)}); continue
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, :3, 3] = r["points"].mean(axis=0)
    wire.write_message(out, {"T_camera_grasps": T, "scores": np.ones(n), "widths_m": np.full(n, np.nan),
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


def test_grasps_cross_over_whole(served, tmp_path):
    grasps = served.sample(CLOUD, 7, 0)
    assert len(grasps) == 7 and np.isnan(grasps.widths_m).all()
    np.testing.assert_array_equal(grasps.T_camera_grasps[3, :3, 3], CLOUD.mean(axis=0))
    assert grasps.source.startswith(f"fake ['fake', '{tmp_path}/weights.yml']")


def test_one_process_answers_many_requests_until_it_is_closed_and_a_new_one_after(served):
    first, again = served.sample(CLOUD, 1, 0).source, served.sample(CLOUD, 1, 0).source
    assert first == again
    served.close()
    assert served.sample(CLOUD, 1, 0).source != first


def test_a_bad_cloud_does_not_cross_over(served):
    with pytest.raises(ValueError, match="not millimetres"):
        served.sample(1000.0 * CLOUD, 1, 1)  # seed 1 would have ended it
    assert len(served.sample(CLOUD, 1, 0)) == 1


@pytest.mark.parametrize(
    ("seed", "error", "message"),
    [
        (1, GeneratorError, "ended with code 7"),
        (2, GeneratorError, "ended with code 3.\n    out of memory"),
        (4, GeneratorError, "no proper answer: a message of"),
        (5, ValueError, "too flat"),
        (6, GeneratorError, "fake: IndexError: oh"),
        (7, GeneratorError, "no grasps"),
    ],
)
def test_each_failure_is_told_and_the_next_request_is_answered(served, seed, error, message):
    with pytest.raises(error, match=message):
        served.sample(CLOUD, 1, seed)
    assert len(served.sample(CLOUD, 4, 0)) == 4


def test_a_process_that_hangs_is_ended_in_time(tmp_path):
    generator = make(tmp_path, READY + SERVE, timeout_s=0.5)
    with pytest.raises(GeneratorError, match=r"no answer in 0\.5 s and was ended"):
        generator.sample(CLOUD, 1, 3)


def test_ctrl_c_while_waiting_ends_it_too(tmp_path, monkeypatch):
    generator = make(tmp_path, READY + SERVE)
    child = generator._child
    assert child is not None

    def interrupt(timeout: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(child, "_answers", SimpleNamespace(get=interrupt))
    with pytest.raises(KeyboardInterrupt):
        generator.sample(CLOUD, 1, 3)
    assert child._process.returncode is not None
    assert len(generator.sample(CLOUD, 1, 0)) == 1


def test_one_that_does_not_start_says_its_last_words(tmp_path):
    with pytest.raises(GeneratorError, match=r"(?s)of fake ended with code 1.*No module named 'grasp_gem'"):
        make(tmp_path, "import grasp_gem")
    with pytest.raises(GeneratorError, match=r"gave no answer in 0\.5 s"):
        make(tmp_path, "import threading; threading.Event().wait()", start_timeout_s=0.5)
    with pytest.raises(GeneratorError, match="cannot be started: No such file"):
        ProcessGenerator("fake", tmp_path, tmp_path / "python")


def test_one_of_another_version_is_refused(tmp_path):
    with pytest.raises(GeneratorError, match="speaks version 99; allowed is 1"):
        make(tmp_path, 'wire.write_message(out, {"protocol": 99})')


def test_its_process_is_gone_when_nobody_holds_the_generator(tmp_path):
    generator = make(tmp_path, READY + SERVE)
    child = generator._child
    assert child is not None
    process = child._process
    del generator, child
    assert process.wait(20.0) == 0


def test_the_real_worker_needs_nothing_of_ours_but_its_room_and_tells_what_is_missing(tmp_path):
    (tmp_path / "x.yml").write_text("data: {}\n")
    code = (
        "import sys, runpy; sys.argv = ['w', 'graspgen', 'none.yml']\n"
        f"try: runpy.run_path({str(WORKER)!r}, run_name='__main__')\n"
        "except SystemExit as end:\n"
        "    ours = [m for m in ('numba', 'scipy', 'pinocchio', 'z1_runtime') if m in sys.modules]\n"
        "    print(ours, end.code, file=sys.stderr)"
    )
    done = subprocess.run([PYTHON, "-I", "-c", code], capture_output=True, check=True, stdin=subprocess.DEVNULL)
    answer = read_message(io.BytesIO(done.stdout))
    assert answer is not None and "none.yml is not there" in str(answer["error"])
    assert done.stderr.decode().strip() == "[] 1"
    with pytest.raises(GeneratorError, match="not there"):
        ProcessGenerator("graspgen", tmp_path / "none.yml", PYTHON)


def test_messages_that_are_cut_too_long_or_no_arrays_are_refused():
    whole = io.BytesIO()
    write_message(whole, {"a": np.arange(3), "b": "words"})
    data = whole.getvalue()
    message = read_message(io.BytesIO(data))
    assert message is not None and message["a"].tolist() == [0, 1, 2] and str(message["b"]) == "words"
    assert read_message(io.BytesIO(b"")) is None
    for cut in (data[:5], data[:-1]):
        with pytest.raises(PipeError, match="ended within"):
            read_message(io.BytesIO(cut))
    with pytest.raises(PipeError, match="announced"):
        read_message(io.BytesIO(b"\xff" * 20))
    with pytest.raises(PipeError, match="no plain arrays"):
        read_message(io.BytesIO(data[:8] + b"x" * (len(data) - 8)))
    with pytest.raises(ValueError, match=r"[Oo]bject arrays"):
        write_message(io.BytesIO(), {"a": np.array([{}], dtype=object)})
