"""Slow and hardware tests are run only where they are asked for."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from tests.conftest import pytest_collection_modifyitems


@pytest.mark.parametrize(
    ("expression", "selected"),
    [
        ("", {"quick", "integration"}),
        ("not integration", {"quick", "integration"}),  # pytest itself deselects these
        ("slow", {"quick", "integration", "slow"}),
        ("hardware and not integration", {"quick", "integration", "hardware"}),
    ],
)
def test_a_marker_expression_brings_back_only_what_it_names(
    expression: str, selected: set[str], request: pytest.FixtureRequest
) -> None:
    names = ("quick", "integration", "slow", "hardware")
    items = [pytest.Function.from_parent(request.node.parent, name=name, callobj=lambda: None) for name in names]
    for item in items[1:]:
        item.add_marker(item.name)
    deselected = []

    def report(items: list[pytest.Item]) -> None:
        deselected.extend(items)

    config = SimpleNamespace(
        option=SimpleNamespace(markexpr=expression), hook=SimpleNamespace(pytest_deselected=report)
    )
    pytest_collection_modifyitems(config, items)  # pyright: ignore[reportArgumentType]
    assert {item.name for item in items} == selected
    assert {item.name for item in deselected} == set(names) - selected
