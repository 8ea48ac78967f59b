"""A small data set for the tests of the training."""

import numpy as np
import pytest

from models.diffusion.training.data import GraspData, load_shards
from models.diffusion.training.grippers import GRIPPERS
from models.diffusion.training.shards import make_shard


@pytest.fixture(scope="session")
def data(tmp_path_factory: pytest.TempPathFactory) -> GraspData:
    folder = tmp_path_factory.mktemp("shards")
    np.savez(folder / "7.npz", allow_pickle=False, **make_shard(GRIPPERS["agnostic"], 7, n_shapes=4, n_views=2))
    return load_shards(folder)
