"""`scripts/train/train_detector.py`: what does not need hours."""

from __future__ import annotations

from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from threading import Event

import pytest

from scripts.train.train_detector import Config, end_with_parent, main

_SPAWN = get_context("spawn")


def test_without_pictures_it_says_how_to_make_them(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match_detections="make_detection_dataset"):
        main(Config(data=tmp_path))


def _learn(end: Connection) -> None:
    end_with_parent()
    end.send("up")
    Event().wait()


def _start(end: Connection) -> None:
    child = _SPAWN.Process(target=_learn, args=(end,))
    child.start()
    child.join()


def test_its_processes_end_when_the_one_that_started_them_is_killed() -> None:
    here, there = _SPAWN.Pipe(duplex=False)
    parent = _SPAWN.Process(target=_start, args=(there,))
    parent.start()
    there.close()
    assert here.recv() == "up"
    parent.kill()
    assert here.poll(60.0), "the child still holds its end of the pipe"
    with pytest.raises(EOFError):
        here.recv()
    parent.join()
