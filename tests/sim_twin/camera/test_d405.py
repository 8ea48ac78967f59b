import numpy as np
import pytest

from sim_twin.camera.d405 import (
    BASELINE_M,
    DEPTH_UNIT_M,
    DISPARITY_SD_PX,
    INTRINSICS,
    MIN_Z_M,
    measure_colour,
    measure_depth,
    round_depth,
)

SHAPE = (INTRINSICS.height, INTRINSICS.width)


def _wall(z_m: float) -> np.ndarray:
    return np.full(SHAPE, z_m, np.float32)


@pytest.mark.parametrize("z_m", [0.15, 0.3, 0.5])
def test_noise_grows_with_the_square_of_the_distance(z_m: float) -> None:
    depth = measure_depth(_wall(z_m), seed=1, sequence=1)
    valid = depth[depth > 0]
    expected = z_m**2 * DISPARITY_SD_PX / (INTRINSICS.fx * BASELINE_M)
    assert np.std(valid) == pytest.approx(expected, rel=0.1)
    assert np.mean(valid) == pytest.approx(z_m, rel=0.005)


def test_noise_is_correlated_between_neighbours_and_not_across_the_image() -> None:
    depth = measure_depth(_wall(0.4), seed=1, sequence=1)[50:400, 100:600]
    error = np.where(depth > 0, depth - 0.4, 0.0)
    near, far = (np.corrcoef(error[:, :-step].ravel(), error[:, step:].ravel())[0, 1] for step in (1, 20))
    assert near > 0.7
    assert abs(far) < 0.05


def test_depth_comes_in_tenths_of_a_millimetre() -> None:
    for depth in (measure_depth(_wall(0.3), seed=0, sequence=1), round_depth(_wall(0.30004))):
        units = depth.astype(np.float64) / DEPTH_UNIT_M
        np.testing.assert_allclose(units, np.round(units), atol=2e-3)
        assert units.max() > 0


def test_depth_steps_are_those_of_a_disparity_in_32nds_of_a_pixel() -> None:
    depth = measure_depth(_wall(0.5), seed=0, sequence=1).astype(np.float64)
    steps = 32.0 * INTRINSICS.fx * BASELINE_M / depth[depth > 0]
    # At 0.5 m one step is 1.1 mm: rounding to 0.1 mm moves a depth by at most 1/22 of it.
    assert np.abs(steps - np.round(steps)).max() < 0.06


def test_nothing_nearer_than_min_z_is_measured() -> None:
    assert not measure_depth(_wall(MIN_Z_M - 0.005), seed=0, sequence=1).any()
    assert not round_depth(_wall(MIN_Z_M - 0.005)).any()
    assert (measure_depth(_wall(MIN_Z_M + 0.005), seed=0, sequence=1) > 0).mean() > 0.5


def test_a_resolution_with_another_min_z_measures_nearer() -> None:
    assert (measure_depth(_wall(0.05), seed=0, sequence=1, min_z_m=0.04) > 0).mean() > 0.5
    assert (round_depth(_wall(0.05), min_z_m=0.04) > 0).all()


def test_the_band_that_only_the_left_imager_sees_is_empty() -> None:
    depth = measure_depth(_wall(0.2), seed=0, sequence=1)
    band = int(INTRINSICS.fx * BASELINE_M / 0.2)
    assert not depth[:, :band].any()
    assert (depth[10:-10, band + 2 : -2] > 0).mean() > 0.98


def test_a_near_thing_casts_its_shadow_to_its_left() -> None:
    z = _wall(0.5)
    z[200:300, 300:400] = 0.25
    depth = measure_depth(z, seed=0, sequence=1)
    shadow = int(INTRINSICS.fx * BASELINE_M * (1 / 0.25 - 1 / 0.5))
    assert not depth[210:290, 300 - shadow + 2 : 299].any()
    assert (depth[210:290, 402 : 402 + shadow] > 0).mean() > 0.95
    assert (depth[210:290, 300 - 2 * shadow : 300 - shadow - 2] > 0).mean() > 0.95


@pytest.mark.integration
def test_surfaces_seen_at_a_grazing_angle_are_not_measured() -> None:
    columns = np.arange(INTRINSICS.width, dtype=np.float32)
    z = np.broadcast_to(0.2 + 0.012 * np.maximum(columns - 400.0, 0.0), SHAPE).astype(np.float32)
    depth = measure_depth(z, seed=0, sequence=1)
    assert (depth[10:-10, 410:440] > 0).mean() < 0.05
    assert (depth[10:-10, 100:390] > 0).mean() > 0.95


def test_the_same_seed_and_frame_give_the_same_bytes_and_others_do_not() -> None:
    z, colour = _wall(0.3), np.full((*SHAPE, 3), 128, np.uint8)
    assert measure_depth(z, 3, 7).tobytes() == measure_depth(z, 3, 7).tobytes()
    assert measure_colour(colour, 3, 7).tobytes() == measure_colour(colour, 3, 7).tobytes()
    for seed, sequence in ((3, 8), (4, 7)):
        assert measure_depth(z, 3, 7).tobytes() != measure_depth(z, seed, sequence).tobytes()
        assert measure_colour(colour, 3, 7).tobytes() != measure_colour(colour, seed, sequence).tobytes()
