import numpy as np
import pytest

from hal.base.errors import InvalidValueError
from sim_twin.model.objects import OBJECT_NAMES, OBJECTS
from sim_twin.model.scene import SceneConfig
from tests.support.errors import raises


@pytest.mark.parametrize(
    ("field", "value", "code", "allowed"),
    [
        ("object", "teapot", "unknown_object", "bottle, box, cylinder"),
        ("distance_m", 0.9, "scene_range", "0.3 to 0.65"),
        ("distance_m", float("nan"), "scene_range", "0.3 to 0.65"),
        ("lateral_m", -0.4, "scene_range", "-0.25 to 0.25"),
        ("pitch_deg", 80.0, "scene_range", "-60 to 60"),
        ("seed", -1, "scene_seed", "whole number"),
        ("seed", 1.5, "scene_seed", "whole number"),
    ],
)
def test_a_bad_field_is_rejected_with_value_and_range(field: str, value: object, code: str, allowed: str) -> None:
    with raises(InvalidValueError, code) as caught:
        SceneConfig(**{field: value})  # type: ignore[arg-type]
    assert repr(value) in str(caught.value)
    assert allowed in str(caught.value)


@pytest.mark.parametrize("name", OBJECT_NAMES)
@pytest.mark.parametrize("pitch_deg", [-60.0, 0.0, 30.0])
def test_the_objects_lowest_point_is_on_the_table(name: str, pitch_deg: float) -> None:
    pose = SceneConfig(object=name, pitch_deg=pitch_deg, distance_m=0.5, lateral_m=0.1).T_base_object()
    points = OBJECTS[name].corners() @ pose[:3, :3].T + pose[:3, 3]
    assert points[:, 2].min() == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(pose[:2, 3], [0.5, 0.1])
    assert np.rad2deg(np.arccos(pose[2, 2])) == pytest.approx(abs(pitch_deg))
