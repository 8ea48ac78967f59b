"""Weights on disk: what was written is read, and nothing else is."""

import numpy as np
import pytest

from models.weights_file import WeightsError, read_arrays, write_arrays


def test_arrays_come_back_as_they_were(tmp_path):
    path = tmp_path / "w.npz"
    arrays = {"a/b": np.arange(6, dtype=np.float16).reshape(2, 3), "names": np.array(["bottle", "box"])}
    digest = write_arrays(path, arrays)
    back = read_arrays(path, "make it")
    assert back.keys() == arrays.keys()
    assert all((back[key] == arrays[key]).all() and back[key].dtype == arrays[key].dtype for key in arrays)
    assert path.with_suffix(".sha256").read_text() == f"{digest}  w.npz\n"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["w.npz", "w.sha256"]


def test_a_changed_file_is_refused(tmp_path):
    path = tmp_path / "w.npz"
    write_arrays(path, {"a": np.zeros(3)})
    path.write_bytes(path.read_bytes() + b"x")
    with pytest.raises(WeightsError, match=r"damaged or was exchanged"):
        read_arrays(path, "make it")


@pytest.mark.parametrize("gone", ["w.npz", "w.sha256"])
def test_a_missing_file_names_the_command_that_makes_it(tmp_path, gone):
    write_arrays(tmp_path / "w.npz", {"a": np.zeros(3)})
    (tmp_path / gone).unlink()
    with pytest.raises(WeightsError, match=f"{gone} is missing; .*`make it`"):
        read_arrays(tmp_path / "w.npz", "make it")


def test_an_empty_checksum_is_refused(tmp_path):
    write_arrays(tmp_path / "w.npz", {"a": np.zeros(3)})
    (tmp_path / "w.sha256").write_text("")
    with pytest.raises(WeightsError, match="says nothing"):
        read_arrays(tmp_path / "w.npz", "make it")


def test_pickled_objects_are_neither_written_nor_read(tmp_path):
    path = tmp_path / "w.npz"
    with pytest.raises(ValueError, match="Object arrays"):
        write_arrays(path, {"a": np.array([{}])})
    assert not list(tmp_path.iterdir())
    write_arrays(path, {"a": np.zeros(3)})
    np.savez(path, a=np.array([{}]))
    from models.weights_file import sha256_of

    path.with_suffix(".sha256").write_text(sha256_of(path))
    with pytest.raises(WeightsError, match="no plain NumPy arrays"):
        read_arrays(path, "make it")


def test_another_ending_is_refused_before_anything_is_written(tmp_path):
    with pytest.raises(ValueError, match=r"must end in \.npz"):
        write_arrays(tmp_path / "w.pt", {"a": np.zeros(3)})
    assert not list(tmp_path.iterdir())
