"""The detector's pictures: what the labels say is what the picture shows."""

from collections.abc import Iterator
from typing import get_args

import mujoco
import numpy as np
import pytest

from hal.base import z1
from sim_twin.camera.d405 import INTRINSICS
from sim_twin.camera.render import make_renderer
from sim_twin.detection_data.photometric_noise import augment_image
from sim_twin.detection_data.props import CLASSES, UNDRAWN_GROUP, make_class_prop, make_distractor, nominal_prop
from sim_twin.detection_data.scene_renderer import SceneRenderer
from sim_twin.detection_data.scenes import (
    MIN_MARK_RATIO,
    MIN_PIXELS,
    MIN_VISIBLE_RATIO,
    Appearance,
    SceneMix,
    draw_scenario,
    draw_scene,
    project_outline,
    visible_ratio,
)
from sim_twin.detection_data.textures import random_texture
from sim_twin.model.objects import OBJECTS
from sim_twin.model.scene import SceneConfig
from sim_twin.model.world import World
from tests.support.gl_here import needs_egl

HOME = np.append(z1.Q_HOME, -1.0)


@pytest.fixture(scope="module")
def renderer() -> Iterator[SceneRenderer]:
    made = SceneRenderer(7)
    yield made
    made.close()


@pytest.mark.integration
@needs_egl
def test_the_same_seed_gives_the_same_picture_and_another_seed_another(renderer: SceneRenderer) -> None:
    first, again, other = (draw_scene(renderer, np.random.default_rng(seed)) for seed in (3, 3, 4))
    assert np.array_equal(first.colour, again.colour)
    assert [label.name for label in first.labels] == [label.name for label in again.labels]
    assert all(np.array_equal(a.mask, b.mask) for a, b in zip(first.labels, again.labels, strict=True))
    assert not np.array_equal(first.colour, other.colour)


@pytest.mark.integration
@needs_egl
def test_labels_are_of_the_three_classes_large_enough_and_apart(renderer: SceneRenderer) -> None:
    seen = 0
    for seed in range(6):
        picture = draw_scene(renderer, np.random.default_rng(seed), SceneMix(empty=0.0))
        assert picture.colour.shape == (INTRINSICS.height, INTRINSICS.width, 3)
        for label in picture.labels:
            assert label.name in CLASSES
            assert label.mask.sum() >= MIN_PIXELS
            left, top, right, bottom = label.box()
            outside = label.mask.copy()
            outside[top:bottom, left:right] = False
            assert not outside.any()
            assert label.mask[top, :].any() and label.mask[bottom - 1, :].any()
            assert label.mask[:, left].any() and label.mask[:, right - 1].any()
        stacked = sum(label.mask.astype(int) for label in picture.labels)
        assert np.max(stacked) <= 1
        seen += len(picture.labels)
    assert seen >= 3


@pytest.mark.integration
@needs_egl
def test_an_empty_scene_has_no_labels(renderer: SceneRenderer) -> None:
    for seed in range(4):
        assert draw_scene(renderer, np.random.default_rng(seed), SceneMix(empty=1.0)).labels == ()


@pytest.mark.integration
@needs_egl
@pytest.mark.parametrize("name", CLASSES)
def test_a_scenario_has_the_mask_that_the_twin_has(renderer: SceneRenderer, name: str) -> None:
    config = SceneConfig(object=name, distance_m=0.48, lateral_m=-0.15, pitch_deg=45.0)
    pose = config.T_base_object()
    picture = draw_scenario(renderer, name, pose, np.random.default_rng(0), appearance="any")
    world = World(config)
    data = world.snapshot()
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, pose[:3, :3].ravel().copy())
    data.qpos[:] = [*HOME, *pose[:3, 3], *quat]
    mujoco.mj_forward(world.model, data)
    renderer = make_renderer(world.model, INTRINSICS, "egl")
    twin = renderer.render(data).mask
    renderer.close()
    ours = picture.labels[0].mask
    assert (ours & twin).sum() / (ours | twin).sum() > 0.99


@pytest.mark.integration
@needs_egl
@pytest.mark.parametrize("appearance", get_args(Appearance))
def test_an_object_has_its_own_colours_unless_any_will_do(renderer: SceneRenderer, appearance: Appearance) -> None:
    instance, pose = renderer.named("cylinder")[0], SceneConfig(object="cylinder").T_base_object()
    own = [part.rgba for part, _ in instance.prop.parts]
    alike = []
    for seed in range(5):
        assert (
            draw_scenario(renderer, "cylinder", pose, np.random.default_rng(seed), appearance=appearance).appearance
            == appearance
        )
        untextured = (renderer.model.geom_matid[instance.geoms] < 0).all()
        alike.append(untextured and np.allclose(renderer.model.geom_rgba[instance.geoms], own))
    assert any(alike) == all(alike) == (appearance != "any")


@needs_egl
def test_what_an_occluder_covers_belongs_to_no_label_and_what_hardly_shows_is_taken_away(
    renderer: SceneRenderer,
) -> None:
    T_base_camera = renderer.set_arm(HOME)
    cylinder, card = renderer.named("cylinder")[0], renderer.distractors()[0]
    pose = SceneConfig(object="cylinder").T_base_object()
    renderer.clear()
    renderer.put(cylinder, pose)
    alone = renderer.draw_instances("wrist", "pieces") == renderer.props.index(cylinder)
    between = np.eye(4)
    between[:3, 3] = 0.6 * pose[:3, 3] + 0.4 * T_base_camera[:3, 3]
    renderer.put(card, between)
    instances = renderer.draw_instances("wrist", "pieces")
    behind = instances == renderer.props.index(cylinder)
    assert behind.sum() < alone.sum()
    assert not (behind & ~alone).any()
    assert (instances == renderer.props.index(card)).any()
    renderer.hide(cylinder)
    assert not (renderer.draw_instances("wrist", "pieces") == renderer.props.index(cylinder)).any()


@pytest.mark.integration
@needs_egl
def test_every_label_shows_enough_of_its_outline(renderer: SceneRenderer) -> None:
    for seed in range(20, 26):
        picture = draw_scene(renderer, np.random.default_rng(seed), SceneMix(empty=0.0, wrist=0.0, occluded=1.0))
        camera = renderer.T_base_camera("free")
        for label in picture.labels:
            areas = []
            for instance in renderer.named(label.name):
                pose = renderer.pose(instance)
                corners = [points @ pose[:3, :3].T + pose[:3, 3] for points in instance.prop.corners()]
                whole = project_outline(corners, camera, renderer.intrinsics)
                areas.append(np.inf if whole is None else 4 * whole.sum())
            assert label.mask.sum() >= min(MIN_VISIBLE_RATIO * min(areas), 0.08 * label.mask.size)


@pytest.mark.integration
@needs_egl
def test_a_bottle_without_its_neck_has_no_label_where_colours_tell_nothing(renderer: SceneRenderer) -> None:
    """Its shoulder cut off by the picture's border, a bottle in random colours is a cylinder."""
    seen = {True: 0, False: 0}
    for seed in range(40, 70):
        rng = np.random.default_rng(seed)
        picture = draw_scene(renderer, rng, SceneMix(empty=0.0, twin=0.0, own=0.0, wrist=0.0, occluded=0.0))
        camera = renderer.T_base_camera("free")
        shown = [a for a in renderer.named("bottle") if renderer.model.geom_group[a.geoms[0]] != UNDRAWN_GROUP]
        masks = [label.mask for label in picture.labels if label.name == "bottle"]
        for instance, mask in zip(shown, masks, strict=True) if len(shown) == len(masks) == 1 else []:
            pose = renderer.pose(instance)
            corners = [points @ pose[:3, :3].T + pose[:3, 3] for points in instance.prop.corners()[-2:]]
            neck = project_outline(corners, camera, renderer.intrinsics)
            assert neck is not None
            seen[visible_ratio(mask, neck) >= MIN_MARK_RATIO] += 1
    assert seen[True] >= 3
    assert seen[False] == 0


def test_the_outline_of_a_plate_square_to_the_camera_is_its_size_in_pixels() -> None:
    plate = np.array([[x, y, 0.5] for x in (-0.05, 0.05) for y in (-0.03, 0.03)])
    wanted = 0.10 * INTRINSICS.fx / 0.5 * 0.06 * INTRINSICS.fy / 0.5
    whole = project_outline([plate], np.eye(4), INTRINSICS)
    assert whole is not None
    assert 4 * whole.sum() == pytest.approx(wanted, rel=0.06)
    mask = np.zeros((INTRINSICS.height, INTRINSICS.width), dtype=bool)
    mask[:, : round(INTRINSICS.cx)] = True
    assert visible_ratio(mask, whole) == pytest.approx(0.5, abs=0.02)


def test_what_comes_too_near_the_lens_has_no_outline() -> None:
    assert project_outline([np.array([[0.0, 0.0, 0.03], [0.0, 0.1, 0.3]])], np.eye(4), INTRINSICS) is None


def test_props_keep_the_proportions_that_tell_them_from_distractors() -> None:
    for seed in range(30):
        rng = np.random.default_rng(seed)
        box = np.ptp(np.vstack(make_class_prop("box", rng).corners()), axis=0)
        assert box.min() >= 0.028
        cylinder = np.ptp(np.vstack(make_class_prop("cylinder", rng).corners()), axis=0)
        assert cylinder[2] >= 1.69 * cylinder[0]
        bottle = make_class_prop("bottle", rng)
        assert len(bottle.parts) == len(OBJECTS["bottle"].parts) + 1
        assert make_distractor(rng).kind not in CLASSES
    assert np.ptp(np.vstack(nominal_prop("bottle").corners()), axis=0)[2] == pytest.approx(0.200)


def test_a_label_high_up_ends_below_the_shoulder() -> None:
    class Extreme:
        def uniform(self, low: float, high: float, size: int | None = None) -> float | np.ndarray:
            return low if size is None else np.full(size, high)  # the label's two edges are drawn at once

    bottle = make_class_prop("bottle", Extreme())  # pyright: ignore[reportArgumentType]
    assert all(min(part.size_m) > 0.0 for part, _ in bottle.parts)


def test_textures_are_pictures_and_come_from_their_seed() -> None:
    for seed in range(30):
        picture = random_texture(np.random.default_rng(seed), 64)
        assert picture.shape == (64, 64, 3) and picture.dtype == np.uint8
        assert np.array_equal(picture, random_texture(np.random.default_rng(seed), 64))
    assert len({random_texture(np.random.default_rng(seed), 64).tobytes() for seed in range(30)}) == 30


def test_a_photograph_is_noisy_in_every_channel_and_brought_to_a_fair_exposure() -> None:
    dark = np.full((120, 160, 3), 12, np.uint8)
    noise = []
    for seed in range(20):
        photo = augment_image(dark, np.random.default_rng(seed))
        assert photo.shape == dark.shape and photo.dtype == np.uint8
        assert photo.mean() > dark.mean()
        noise.append(photo.std(axis=(0, 1)))
    assert (np.median(noise, axis=0) > 1.0).all()


@pytest.mark.integration
@needs_egl
def test_a_crowd_shows_more_objects(renderer: SceneRenderer) -> None:
    def shown(crowd: float) -> list[int]:
        mix = SceneMix(empty=0.0, twin=0.0, own=0.0, crowd=crowd)
        return [len(draw_scene(renderer, np.random.default_rng([5, n]), mix).labels) for n in range(5)]

    few, many = shown(0.0), shown(1.0)
    assert max(few) <= 3
    assert sum(many) > sum(few)
    assert max(many) > 3


@pytest.mark.integration
@needs_egl
def test_the_number_of_distractors_can_be_raised(renderer: SceneRenderer) -> None:
    def shown(distractors: float) -> int:
        mix = SceneMix(crowd=0.5, occluded=0.0, distractors=distractors)
        counts = []
        for n in range(4):
            draw_scene(renderer, np.random.default_rng([6, n]), mix)
            counts.append(sum(renderer.is_shown(instance) for instance in renderer.distractors()))
        return sum(counts)

    none, some, many = shown(0.0), shown(2.0), shown(6.0)
    assert none == 0
    assert 0 < some < many


@pytest.mark.integration
@needs_egl
def test_every_mug_shows_its_handle(renderer: SceneRenderer) -> None:
    """Without it a mug is a cylinder, which a picture must not show without a label."""
    seen = 0
    for seed in range(200, 245):
        draw_scene(renderer, np.random.default_rng(seed), SceneMix(empty=1.0, wrist=0.0))
        for mug in renderer.distractors():
            if mug.prop.kind != "mug" or not renderer.is_shown(mug):
                continue
            number = renderer.props.index(mug)
            whole = renderer.draw_instances("free", "none") == number
            renderer.model.geom_group[mug.geoms[2:]] = UNDRAWN_GROUP
            without = renderer.draw_instances("free", "none") == number
            renderer.put(mug, renderer.pose(mug))
            assert (whole & ~without).sum() > 0.04 * whole.sum()
            seen += 1
    assert seen >= 3
