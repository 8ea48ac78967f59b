"""Weights on disk: written arrays are read back, and any other file is rejected."""

import numpy as np
import pytest

from hal.base.errors import InvalidValueError
from models.weights_file import WeightsError, read_arrays, write_arrays
from tests.support.errors import raises


def test_arrays_come_back_as_they_were(tmp_path):
    path = tmp_path / "w.npz"
    arrays = {"a/b": np.arange(6, dtype=np.float16).reshape(2, 3), "names": np.array(["bottle", "box"])}
    digest = write_arrays(path, arrays)
    back = read_arrays(path, "make it")
    assert back.keys() == arrays.keys()
    assert all((back[key] == arrays[key]).all() and back[key].dtype == arrays[key].dtype for key in arrays)
    assert path.with_suffix(".sha256").read_text() == f"{digest}  w.npz\n"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["w.npz", "w.sha256"]


def test_a_changed_file_is_rejected(tmp_path):
    path = tmp_path / "w.npz"
    write_arrays(path, {"a": np.zeros(3)})
    path.write_bytes(path.read_bytes() + b"x")
    with raises(WeightsError, "weights_damaged"):
        read_arrays(path, "make it")


@pytest.mark.parametrize("gone", ["w.npz", "w.sha256"])
def test_a_missing_file_names_the_command_that_makes_it(tmp_path, gone):
    write_arrays(tmp_path / "w.npz", {"a": np.zeros(3)})
    (tmp_path / gone).unlink()
    with raises(WeightsError, "weights_missing") as caught:
        read_arrays(tmp_path / "w.npz", "make it")
    assert gone in str(caught.value) and "`make it`" in str(caught.value)


def test_an_empty_checksum_is_rejected(tmp_path):
    write_arrays(tmp_path / "w.npz", {"a": np.zeros(3)})
    (tmp_path / "w.sha256").write_text("")
    with raises(WeightsError, "weights_damaged"):
        read_arrays(tmp_path / "w.npz", "make it")


def test_pickled_objects_are_neither_written_nor_read(tmp_path):
    path = tmp_path / "w.npz"
    with pytest.raises(ValueError):
        write_arrays(path, {"a": np.array([{}])})
    assert not list(tmp_path.iterdir())
    write_arrays(path, {"a": np.zeros(3)})
    np.savez(path, a=np.array([{}]))
    from models.weights_file import sha256_of

    path.with_suffix(".sha256").write_text(sha256_of(path))
    with raises(WeightsError, "weights_not_arrays"):
        read_arrays(path, "make it")


def test_another_suffix_is_rejected_before_writing(tmp_path):
    with raises(InvalidValueError, "weights_suffix"):
        write_arrays(tmp_path / "w.pt", {"a": np.zeros(3)})
    assert not list(tmp_path.iterdir())
