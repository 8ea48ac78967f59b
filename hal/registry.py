"""Registry of backends: lazy `"module:attribute"` strings, so that listing them imports no SDK and no simulator."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any, Generic, TypeVar

from hal.base.arm import Arm
from hal.base.camera import Camera
from hal.base.errors import InvalidValueError, UnknownBackendError

T = TypeVar("T")


class Registry(Generic[T]):
    """Names of one kind of backend."""

    def __init__(self, kind: str, entries: Mapping[str, str]) -> None:
        self._kind = kind
        self._entries = dict(entries)

    def register(self, name: str, target: str) -> None:
        """Add `name` as `"module:attribute"`.

        Raises:
            InvalidValueError: the name is taken (`name_taken`).
        """
        if name in self._entries:
            raise InvalidValueError(
                f"registry: {self._kind} backend {name!r} is registered already, as {self._entries[name]}. Choose "
                f"another name.",
                code="name_taken",
            )
        self._entries[name] = target

    def names(self) -> list[str]:
        """Return all names, sorted."""
        return sorted(self._entries)

    def make(self, name: str, **options: Any) -> T:
        """Import the backend and call it with `options`.

        Raises:
            UnknownBackendError: no backend has that name; the message lists the known ones.
        """
        if name not in self._entries:
            raise UnknownBackendError(self._kind, name, self._entries)
        module, attribute = self._entries[name].split(":")
        return getattr(import_module(module), attribute)(**options)


ARMS: Registry[Arm] = Registry(
    "arm",
    {
        "mock": "hal.backends.mock_arm:MockArm",
        "sim": "sim_twin.backends:TwinArm",
        "z1": "hal.backends.z1.arm:Z1Arm",
    },
)
CAMERAS: Registry[Camera] = Registry(
    "camera",
    {
        "d405": "hal.backends.d405.camera:D405Camera",
        "replay": "hal.backends.replay_camera:ReplayCamera",
        "sim": "sim_twin.backends:TwinCamera",
    },
)
