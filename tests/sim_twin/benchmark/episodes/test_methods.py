import pytest

from sim_twin.benchmark.episodes.methods import METHODS, parse_method


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
    ("text", "said"),
    [
        ("best", "known: vanilla, mvb, full"),
        ("mvb:beta=1", "unknown setting 'beta'"),
        ("mvb:k=two", "no number"),
        ("mvb:box=sphere", "allowed: pca"),
        ("mvb:hard_filter=maybe", "yes or no"),
    ],
)
def test_a_method_that_is_not_there_is_refused_with_what_is(text, said):
    with pytest.raises(ValueError, match=said):
        parse_method(text)
