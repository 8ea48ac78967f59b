"""A disk that fills up during a recording ends the recording alone, with a warning."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from hal.base.messages import Intrinsics, RgbdFrame
from tests.support.faults_table import FaultsTable
from z1_runtime.visualization.rerun_logger import RerunLogger

K = Intrinsics(width=320, height=240, fx=300.0, fy=300.0, cx=159.5, cy=119.5)
FILE_LIMIT = 2**20


@pytest.fixture
def limited_file_size() -> Iterator[None]:
    """Limit the files of this process to 1 MB, which to a writer is a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (FILE_LIMIT, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


def noisy_frame(n: int) -> RgbdFrame:
    rng = np.random.default_rng(n)
    return RgbdFrame(
        colour=rng.integers(0, 255, (K.height, K.width, 3), dtype=np.uint8),
        depth_m=rng.uniform(0.1, 1.0, (K.height, K.width)).astype(np.float32),
        intrinsics=K,
        stamp_s=0.5 * n,
        sequence=n,
    )


@pytest.mark.integration
@pytest.mark.faults
@pytest.mark.usefixtures("limited_file_size")
def test_a_disk_that_fills_up_ends_the_recording_and_not_the_pick(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, faults_table: FaultsTable
) -> None:
    out = tmp_path / "episode.rrd"
    logger = RerunLogger(out, max_frames=100)
    frames = 20
    for n in range(frames):
        logger.log_frame(noisy_frame(n), np.eye(4))
    logger.close()
    assert out.stat().st_size <= FILE_LIMIT
    assert "the recording may lack its end" in caplog.text
    faults_table.add(
        "disk full while recording",
        arm=f"continues: {frames} frames were logged, {out.stat().st_size >> 10} KiB of them kept",
        reads=caplog.records[-1].getMessage(),
    )


@pytest.mark.faults
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="Linux has a disk that is always full")
def test_a_disk_that_is_full_at_the_start_is_one_clear_error(faults_table: FaultsTable) -> None:
    with pytest.raises(OSError) as caught:
        RerunLogger(Path("/dev/full"))
    assert "/dev/full" in str(caught.value) and "No space left on device" in str(caught.value)
    faults_table.add("disk full before recording", arm="does not move", reads=caught.value)
