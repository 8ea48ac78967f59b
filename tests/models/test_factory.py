"""Generators by name: those of this project, and those that installed packages add by an entry point."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.metadata import EntryPoint

import pytest

from hal.base.errors import InvalidValueError
from models import factory
from models.samplers.obb_sweep import ObbSweepSampler
from models.samplers.union import UnionSampler
from tests.support.errors import raises


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A package that adds the generator `mine` and tries to replace `antipodal`."""
    value = "models.samplers.obb_sweep:ObbSweepSampler"
    entries = [EntryPoint(name, value, factory.ENTRY_POINTS) for name in ("mine", "antipodal")]
    monkeypatch.setattr(factory, "entry_points", lambda group: [e for e in entries if e.group == group])
    factory.installed_generators.cache_clear()
    yield
    factory.installed_generators.cache_clear()


@pytest.mark.usefixtures("installed")
def test_an_installed_package_adds_a_generator_and_replaces_none() -> None:
    assert isinstance(factory.make_generator("mine"), ObbSweepSampler)
    assert not isinstance(factory.make_generator("antipodal"), ObbSweepSampler)
    assert isinstance(factory.make_generator("union:mine+antipodal"), UnionSampler)


@pytest.mark.usefixtures("installed")
def test_an_unknown_name_is_answered_with_the_installed_ones_too() -> None:
    with raises(InvalidValueError, "unknown_generator") as caught:
        factory.make_generator("yours")
    assert "mine" in str(caught.value)
