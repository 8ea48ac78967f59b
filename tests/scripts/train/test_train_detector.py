"""`scripts/train/train_detector.py`: missing data, and the end of its processes."""

from __future__ import annotations

from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from threading import Event

import pytest

from hal.base.errors import MissingFileError
from scripts.train.train_detector import Config, end_with_parent, main
from tests.support.errors import raises

_SPAWN = get_context("spawn")


def test_missing_pictures_are_reported_with_the_command_that_makes_them(tmp_path: Path) -> None:
    with raises(MissingFileError, "no_data") as caught:
        main(Config(data=tmp_path))
    assert "make_detection_dataset" in str(caught.value)


def _learn(end: Connection) -> None:
    end_with_parent()
    end.send("up")
    Event().wait()


def _start(end: Connection) -> None:
    child = _SPAWN.Process(target=_learn, args=(end,))
    child.start()
    child.join()


@pytest.mark.integration
def test_its_processes_end_when_their_parent_is_killed() -> None:
    here, there = _SPAWN.Pipe(duplex=False)
    parent = _SPAWN.Process(target=_start, args=(there,))
    parent.start()
    there.close()
    assert here.recv() == "up"
    parent.kill()
    assert here.poll(60.0), "the child's end of the pipe is still open"
    with pytest.raises(EOFError):
        here.recv()
    parent.join()
