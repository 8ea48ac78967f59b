import pytest

from hal.base.errors import InvalidValueError
from sim_twin.benchmark.episodes.methods import METHODS, parse_method
from tests.support.errors import raises


def test_a_method_is_named_with_its_settings():
    method = parse_method("mvb:k=3,alpha=0.5,box=upright,hard_filter=no,collision_filter=no")
    assert (method.k, method.alpha, method.box) == (3, 0.5, "upright")
    assert not method.hard_filter
    assert not method.collision_filter
    assert method.name.startswith("mvb:k=3")


def test_the_papers_methods_have_the_papers_numbers():
    assert (METHODS["mvb"].k, METHODS["mvb"].alpha, METHODS["mvb"].box) == (2, 0.85, "pca")
    assert METHODS["vanilla"].rank_by == "score"


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("best", "unknown_method"),
        ("mvb:beta=1", "unknown_setting"),
        ("mvb:k=two", "method_value"),
        ("mvb:box=sphere", "method_value"),
        ("mvb:hard_filter=maybe", "method_value"),
    ],
)
def test_an_unknown_method_or_setting_is_rejected(text, code):
    with raises(InvalidValueError, code):
        parse_method(text)
