"""What only the twin knows, over Zenoh and for evaluation alone: where the object is, how the scene looks."""

from __future__ import annotations

import io
from dataclasses import dataclass

import msgpack
import numpy as np
import zenoh
from PIL import Image

from hal.bus.session import BusConfig, open_session
from hal.errors import HalTimeoutError
from sim_twin.world import World

_TRUTH = "eval/truth"
_PICTURE = "eval/picture"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Truth:
    """The object as it really is."""

    object: str
    """Its name."""
    T_base_object: np.ndarray
    """(4, 4) its pose."""
    lifted_m: float
    """How much higher its lowest point is than at the start [m]."""


def read_truth(world: World) -> Truth:
    """Return the truth about `world` at this moment."""
    return Truth(object=world.config.object, T_base_object=world.T_base_object(), lifted_m=world.lifted_m())


class TruthServer:
    """Answers questions about a world, beside its HAL process."""

    def __init__(self, session: zenoh.Session, world: World) -> None:
        self._world = world
        # Each queryable's callback has a thread of its own, so a slow picture holds up nobody.
        self._queryables = [
            session.declare_queryable(_TRUTH, self._answer_truth),
            session.declare_queryable(_PICTURE, self._answer_picture),
        ]

    def close(self) -> None:
        """Answer no more."""
        for queryable in self._queryables:
            queryable.undeclare()

    def _answer_truth(self, query: zenoh.Query) -> None:
        truth = read_truth(self._world)
        payload = {"object": truth.object, "T": truth.T_base_object.ravel().tolist(), "lifted_m": truth.lifted_m}
        query.reply(query.key_expr, msgpack.packb(payload))

    def _answer_picture(self, query: zenoh.Query) -> None:
        query.reply(query.key_expr, png(self._world.render_view(1280, 720)))


class TruthClient:
    """Asks a twin's HAL process."""

    def __init__(self, config: BusConfig) -> None:
        self._session = open_session(config, listen=False)

    def truth(self) -> Truth:
        """Return the truth at this moment.

        Raises:
            HalTimeoutError: no twin answers, for instance because the HAL drives a real arm.
        """
        data = msgpack.unpackb(self._ask(_TRUTH, timeout_s=2.0))
        T_base_object = np.array(data["T"]).reshape(4, 4)
        return Truth(object=data["object"], T_base_object=T_base_object, lifted_m=data["lifted_m"])

    def picture(self) -> bytes:
        """Return a picture of the scene as PNG.

        Raises:
            HalTimeoutError: as `truth`.
        """
        return self._ask(_PICTURE, timeout_s=20.0)

    def close(self) -> None:
        """Hang up."""
        self._session.close()

    def _ask(self, key: str, timeout_s: float) -> bytes:
        for reply in self._session.get(key, timeout=timeout_s):
            if reply.ok is not None:
                return reply.ok.payload.to_bytes()
        raise HalTimeoutError(f"no twin answered {key!r} within {timeout_s} s; only a simulated HAL knows the truth.")


def png(image: np.ndarray) -> bytes:
    """Return an (H, W, 3) uint8 RGB image as the bytes of a PNG file."""
    file = io.BytesIO()
    Image.fromarray(image).save(file, format="PNG", optimize=True)
    return file.getvalue()
