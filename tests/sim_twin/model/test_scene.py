import numpy as np
import pytest

from sim_twin.model.objects import OBJECT_NAMES, OBJECTS
from sim_twin.model.scene import SceneConfig


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("object", "teapot", "bottle, box, cylinder"),
        ("distance_m", 0.9, "0.3 to 0.65 m"),
        ("distance_m", float("nan"), "0.3 to 0.65 m"),
        ("lateral_m", -0.4, "-0.25 to 0.25 m"),
        ("pitch_deg", 80.0, "-60 to 60 degrees"),
        ("seed", -1, "whole number"),
        ("seed", 1.5, "whole number"),
    ],
)
def test_a_bad_field_is_refused_with_what_is_allowed(field: str, value: object, words: str) -> None:
    with pytest.raises(ValueError, match=words) as caught:
        SceneConfig(**{field: value})  # type: ignore[arg-type]
    assert repr(value) in str(caught.value)


@pytest.mark.parametrize("name", OBJECT_NAMES)
@pytest.mark.parametrize("pitch_deg", [-60.0, 0.0, 30.0])
def test_the_objects_lowest_point_is_on_the_table(name: str, pitch_deg: float) -> None:
    pose = SceneConfig(object=name, pitch_deg=pitch_deg, distance_m=0.5, lateral_m=0.1).T_base_object()
    points = OBJECTS[name].corners() @ pose[:3, :3].T + pose[:3, 3]
    assert points[:, 2].min() == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(pose[:2, 3], [0.5, 0.1])
    assert np.rad2deg(np.arccos(pose[2, 2])) == pytest.approx(abs(pitch_deg))
