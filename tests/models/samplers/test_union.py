"""A union of generators: all sampled, scored by one scorer, near duplicates thinned."""

from __future__ import annotations

import numpy as np
import pytest

from hal.base.errors import InvalidValueError
from hal.base.transforms import inverse
from models.diffusion.sampler import DiffusionSampler
from models.diffusion.training.grippers import GRIPPERS
from models.diffusion.training.labels import check_grasps
from models.diffusion.training.shapes import make_shape
from models.diffusion.training.views import ViewConfig, render_view
from models.factory import make_generator
from models.samplers.antipodal import AntipodalSampler
from models.samplers.obb_sweep import ObbSweepSampler
from models.samplers.union import UnionSampler, find_duplicates
from models.types import GraspSet
from tests.support.errors import raises

CLOUD = np.random.default_rng(0).uniform([-0.03, -0.05, 0.38], [0.03, 0.05, 0.42], (200, 3))


class RowGenerator:
    """Generator of `n` grasps in a row from `start` along x."""

    def __init__(self, start_m: float, step_m: float = 0.01, name: str = "at") -> None:
        self.start_m, self.step_m, self.name = start_m, step_m, name

    def sample(self, points: np.ndarray, n: int, seed: int) -> GraspSet:
        T = np.tile(np.eye(4), (n, 1, 1))
        T[:, 0, 3] = self.start_m + self.step_m * np.arange(n)
        return GraspSet(T_camera_grasps=T, scores=np.ones(n), widths_m=np.full(n, 0.05), source=self.name)


class EmptyGenerator:
    def sample(self, points: np.ndarray, n: int, seed: int) -> GraspSet:
        raise InvalidValueError("nothing to hold here", code="no_grasps")


class ScoreByX:
    """Scorer by x alone, with a count of its grasps."""

    def __init__(self) -> None:
        self.count = 0

    def score(self, points: np.ndarray, grasps: GraspSet, seed: int) -> np.ndarray:
        self.count = len(grasps)
        return 1.0 / (1.0 + np.exp(-grasps.T_camera_grasps[:, 0, 3]))


def test_every_member_samples_all_and_the_best_by_one_scorer_are_kept():
    scorer = ScoreByX()
    grasps = UnionSampler([RowGenerator(0.0, name="a"), RowGenerator(0.055, name="b")], scorer).sample(CLOUD, 10, 0)
    assert scorer.count == 20
    assert len(grasps) == 10
    expected = np.sort(np.concatenate([0.01 * np.arange(10), 0.055 + 0.01 * np.arange(10)]))[::-1][:10]
    np.testing.assert_allclose(grasps.T_camera_grasps[:, 0, 3], expected)
    assert (np.diff(grasps.scores) <= 0.0).all()
    assert grasps.source == "union:a+b"


def test_of_near_duplicates_only_the_best_counts_while_there_are_others():
    twins = UnionSampler([RowGenerator(0.0), RowGenerator(0.001)], ScoreByX())
    grasps = twins.sample(CLOUD, 10, 0)
    np.testing.assert_allclose(grasps.T_camera_grasps[:, 0, 3], 0.001 + 0.01 * np.arange(10)[::-1])


def test_duplicates_fill_up_without_other_grasps():
    same = UnionSampler([RowGenerator(0.0, step_m=0.0), RowGenerator(0.0, step_m=0.0)], ScoreByX())
    assert len(same.sample(CLOUD, 8, 0)) == 8


def test_a_gripper_turned_over_is_a_duplicate_and_another_pose_is_not():
    here, over, across, reversed_approach = (np.eye(4) for _ in range(4))
    over[:3, :3] = np.diag([-1.0, -1.0, 1.0])
    across[:3, :3] = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    reversed_approach[:3, :3] = np.diag([1.0, -1.0, -1.0])
    far = np.eye(4)
    far[0, 3] = 0.004
    np.testing.assert_array_equal(
        find_duplicates(np.stack([here, over, across, reversed_approach, far])), [False, True, False, False, False]
    )


def test_a_duplicate_of_a_dropped_grasp_alone_is_kept():
    row = np.tile(np.eye(4), (3, 1, 1))
    row[:, 0, 3] = [0.0, 0.002, 0.004]
    np.testing.assert_array_equal(find_duplicates(row), [False, True, False])


def test_a_member_without_grasps_is_skipped_but_not_all_of_them():
    assert len(UnionSampler([EmptyGenerator(), RowGenerator(0.0)], ScoreByX()).sample(CLOUD, 5, 0)) == 5
    with raises(InvalidValueError, "no_grasps"):
        UnionSampler([EmptyGenerator(), EmptyGenerator()], ScoreByX()).sample(CLOUD, 5, 0)


def test_bad_clouds_and_single_members_are_rejected():
    with raises(InvalidValueError, "cloud_extent"):
        UnionSampler([RowGenerator(0.0), RowGenerator(0.1)], ScoreByX()).sample(1000.0 * CLOUD, 5, 0)
    with raises(InvalidValueError, "union_members"):
        UnionSampler([RowGenerator(0.0)], ScoreByX())


@pytest.mark.integration
def test_sweep_and_diffusion_together_hold_no_worse_than_the_sweep_alone():
    union = make_generator("union:obb_sweep+diffusion")
    assert isinstance(union, UnionSampler)
    assert [type(member) for member in union.members] == [ObbSweepSampler, DiffusionSampler]
    joined, alone = [], []
    for seed, family in enumerate(("lathe", "cone", "cup")):
        rng = np.random.default_rng(70 + seed)
        solid = make_shape(family, rng)
        view = render_view(solid, ViewConfig(occluded_view_ratio=0.0), rng)
        assert view is not None
        points, T_camera_object = view
        for generator, valid in ((union, joined), (union.members[0], alone)):
            grasps = generator.sample(points, 150, 0)
            T = inverse(T_camera_object) @ grasps.T_camera_grasps
            valid.append(check_grasps(solid, T, GRIPPERS["agnostic"]).valid.mean())
    again, once_more = (union.sample(points, 50, 0) for _ in range(2))
    np.testing.assert_array_equal(again.T_camera_grasps, once_more.T_camera_grasps)
    assert np.mean(joined) >= np.mean(alone)


def test_a_union_is_made_of_any_two_by_name():
    union = make_generator("union:antipodal+obb_sweep")
    assert isinstance(union, UnionSampler)
    assert [type(member) for member in union.members] == [AntipodalSampler, ObbSweepSampler]
