"""Benchmark method that fails with an exception; a module, so that worker processes can import it."""

from __future__ import annotations

from dataclasses import dataclass

from sim_twin.benchmark.episodes.methods import Method


class InjectedError(Exception):
    """Stand-in for a defect of the software under test."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FailingMethod(Method):
    """Method whose ranking raises `InjectedError`."""

    def order(self, *_: object):
        raise InjectedError("the ranking is broken")


FAILING = FailingMethod(name="vanilla", rank_by="score")
