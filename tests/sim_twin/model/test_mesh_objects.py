from pathlib import Path

import numpy as np
import pytest
import trimesh

from sim_twin.model import mesh_objects
from sim_twin.model.mesh_objects import MeshError, cache_folder, load_mesh_object
from sim_twin.model.scene import SceneConfig
from sim_twin.model.world import World
from tests.support.errors import raises


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def write(path: Path, mesh: trimesh.Trimesh) -> Path:
    mesh.export(path)
    return path


def bracket() -> trimesh.Trimesh:
    """Return an L of two bars in millimetres, 60 × 40 × 90 mm, well off the origin."""
    foot = trimesh.creation.box((60.0, 40.0, 20.0), trimesh.transformations.translation_matrix((230.0, 50.0, 10.0)))
    post = trimesh.creation.box((20.0, 40.0, 70.0), trimesh.transformations.translation_matrix((210.0, 50.0, 55.0)))
    return trimesh.util.concatenate([foot, post])


@pytest.mark.integration
@pytest.mark.parametrize("suffix", [".stl", ".obj", ".ply"])
def test_a_concave_mesh_keeps_its_size_mass_and_hollow(tmp_path, suffix):
    name, grasp_object = load_mesh_object(write(tmp_path / f"bracket{suffix}", bracket()), 1e-3, 0.15)
    assert name.startswith("bracket-")
    np.testing.assert_allclose(np.ptp(grasp_object.corners(), axis=0), [0.060, 0.040, 0.090], atol=2e-3)
    np.testing.assert_allclose(grasp_object.corners().min(axis=0), -grasp_object.corners().max(axis=0), atol=1e-9)
    assert grasp_object.mass_kg == pytest.approx(0.15)
    assert len(grasp_object.parts) > 1
    assert grasp_object.is_stable
    in_the_corner = np.array([0.020, 0.0, 0.030])
    assert not any(_is_inside(part.corners(), in_the_corner) for part in grasp_object.parts)


def _is_inside(corners: np.ndarray, point: np.ndarray) -> bool:
    equations = mesh_objects.ConvexHull(corners).equations
    return bool((equations[:, :3] @ point + equations[:, 3] < 0).all())


@pytest.mark.integration
def test_it_rests_in_the_scene_on_its_lowest_point(tmp_path):
    name, grasp_object = load_mesh_object(write(tmp_path / "bracket.stl", bracket()), 1e-3, 0.15)
    for pitch_deg in (0.0, 45.0):
        scene = SceneConfig(object=name, shape=grasp_object, pitch_deg=pitch_deg)
        pose = scene.T_base_object()
        assert (grasp_object.corners() @ pose[:3, :3].T + pose[:3, 3])[:, 2].min() == pytest.approx(0.0, abs=1e-12)
        world = World(scene)
        world.advance_to(0.5)
        np.testing.assert_allclose(world.T_base_object()[:3, 3], pose[:3, 3], atol=2e-3)
        assert world.fixture_holds == (pitch_deg != 0)


@pytest.mark.integration
def test_an_open_surface_is_taken_as_filled(tmp_path):
    tube = trimesh.creation.cylinder(0.03, height=0.08, sections=16)
    tube.update_faces(tube.face_normals[:, 2] < 0.9)
    assert not tube.is_watertight
    _, grasp_object = load_mesh_object(write(tmp_path / "open.ply", tube), 1.0, 0.1)
    np.testing.assert_allclose(np.ptp(grasp_object.corners(), axis=0), [0.06, 0.06, 0.08], atol=1e-3)
    assert any(_is_inside(part.corners(), np.array([0.005, 0.0, 0.02])) for part in grasp_object.parts)


@pytest.mark.integration
def test_what_cannot_stand_is_held(tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.03)
    top = trimesh.creation.cone(radius=0.03, height=0.08, transform=np.diag([1.0, -1.0, -1.0, 1.0]))
    for mesh in (ball, top):
        name, grasp_object = load_mesh_object(write(tmp_path / "thing.stl", mesh), 1.0, 0.1)
        assert not grasp_object.is_stable
        assert World(SceneConfig(object=name, shape=grasp_object)).fixture_holds


@pytest.mark.integration
def test_the_second_time_nothing_is_decomposed(tmp_path, monkeypatch):
    import coacd

    path = write(tmp_path / "bracket.stl", bracket())
    first = load_mesh_object(path, 1e-3, 0.15)
    (stored,) = cache_folder().iterdir()
    monkeypatch.setattr(coacd, "run_coacd", None)
    assert load_mesh_object(path, 1e-3, 0.15) == first
    smaller, _ = load_mesh_object(path, 0.9e-3, 0.15)
    assert smaller != first[0]
    stored.unlink()
    with pytest.raises(TypeError):
        load_mesh_object(path, 1e-3, 0.15)


@pytest.mark.parametrize(
    ("scale", "code", "advice"),
    [
        (1.0, "mesh_size", "60 × 40 × 90 m with --scale 1, allowed 0.02 to 0.35 m"),
        (1e-6, "mesh_size", "Give --scale 0.001 if it is in millimetres"),
        (0.0, "mesh_scale", "above 0"),
        (float("nan"), "mesh_scale", "above 0"),
    ],
)
def test_an_absurd_size_is_rejected_with_the_scale_to_give(tmp_path, scale, code, advice):
    path = write(tmp_path / "bracket.stl", bracket())
    with raises(MeshError, code) as caught:
        load_mesh_object(path, scale, 0.1)
    assert advice in str(caught.value)
    assert not cache_folder().exists()


def test_metres_read_as_millimetres_are_rejected(tmp_path):
    path = write(tmp_path / "box.obj", trimesh.creation.box((0.06, 0.05, 0.08)))
    with raises(MeshError, "mesh_size"):
        load_mesh_object(path, 1e-3, 0.1)


def test_files_that_are_no_mesh_are_rejected(tmp_path):
    with raises(MeshError, "mesh_unreadable"):
        load_mesh_object(tmp_path / "gone.stl", 1.0, 0.1)
    with raises(MeshError, "mesh_suffix"):
        load_mesh_object(tmp_path / "drawing.step", 1.0, 0.1)
    (tmp_path / "points.ply").write_bytes(trimesh.PointCloud(np.eye(3)).export(file_type="ply"))
    with raises(MeshError, "mesh_no_faces"):
        load_mesh_object(tmp_path / "points.ply", 1.0, 0.1)
    (tmp_path / "broken.stl").write_bytes(b"solid nothing\nfacet normal a b c\n")
    with raises(MeshError, "mesh_no_faces"):
        load_mesh_object(tmp_path / "broken.stl", 1.0, 0.1)
    path = write(tmp_path / "box.stl", trimesh.creation.box((0.06, 0.05, 0.08)))
    with raises(MeshError, "mesh_mass"):
        load_mesh_object(path, 1.0, 0.0)
    flat = trimesh.Trimesh(np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0.1, 0.1, 0]]), [[0, 1, 2], [1, 3, 2]])
    with raises(MeshError, "mesh_flat"):
        load_mesh_object(write(tmp_path / "flat.stl", flat), 1.0, 0.1)


@pytest.mark.integration
def test_what_has_a_round_bottom_does_not_stand_though_its_corners_make_feet(tmp_path):
    pill = trimesh.creation.capsule(height=60.0, radius=24.0)
    _, grasp_object = load_mesh_object(write(tmp_path / "pill.stl", pill), 1e-3, 0.2)
    assert not grasp_object.is_stable
    tin = trimesh.creation.cylinder(24.0, height=108.0, sections=24)
    _, grasp_object = load_mesh_object(write(tmp_path / "tin.stl", tin), 1e-3, 0.2)
    assert grasp_object.is_stable
