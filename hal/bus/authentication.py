"""Authentication of the messages of the link: one code (HMAC-SHA256) over each request, answer, state and heartbeat.

Two secrets sign. The link's (`hal.bus.runtime_files`) belongs to the user: the HAL signs all that it sends, and a
client its claim and its questions. The lease's is drawn at each claim and known to the claimant alone: it signs all
that moves the arm, with a counter, so that no message counts twice. Off loopback the link has no secret, because
the certificates of TLS take its place; the lease's remains.
"""

from __future__ import annotations

import hashlib
import hmac
import os
import secrets
import struct
from collections import deque
from dataclasses import dataclass, field

from hal.base.errors import HalError, InvalidMessageError

NO_SECRET = b""
"""Secret of a link whose ends TLS has authenticated."""
CODE_BYTES = hashlib.sha256().digest_size
_STAMP = struct.Struct(f"<16sQ{CODE_BYTES}s")
_MAX_NAME_BYTES = 200
_CLAIMS_KEPT = 10_000
"""Claims whose numbers are kept against repetition; only a client that has the link's secret can push one out."""


def compute_code(secret: bytes, purpose: str, *parts: bytes) -> bytes:
    """Return the authentication code of `parts` for one `purpose`, such as "answer srv/claim"."""
    framed = b"".join(len(part).to_bytes(8, "little") + part for part in (purpose.encode(), *parts))
    return hmac.digest(secret, framed, "sha256")


def verify_code(code: bytes, secret: bytes, purpose: str, *parts: bytes) -> bool:
    """Return True when `code` is the one of `compute_code`; takes the same time for every wrong code."""
    return hmac.compare_digest(code, compute_code(secret, purpose, *parts))


@dataclass(frozen=True, slots=True, kw_only=True)
class Request:
    """A query as the HAL receives it, or a heartbeat, not yet verified."""

    key: str
    """Its key expression."""
    payload: bytes
    name: str = ""
    """Name that the client gave itself."""
    nonce: bytes = bytes(16)
    """Random number that binds the answer to the query."""
    counter: int = 0
    """Number of the message; it increases with each of one client."""
    code: bytes = field(default=bytes(CODE_BYTES), repr=False)
    """Authentication code; zeros in a message without one."""

    @staticmethod
    def make(secret: bytes | None, key: str, payload: bytes, name: str, counter: int) -> Request:
        """Return the request signed by `secret`; None leaves it unsigned."""
        nonce = os.urandom(16)
        unsigned = Request(key=key, payload=payload, name=name, nonce=nonce, counter=counter)
        return unsigned if secret is None else unsigned._with_code(secret)

    def _with_code(self, secret: bytes) -> Request:
        code = compute_code(secret, *self._signed())
        return Request(
            key=self.key, payload=self.payload, name=self.name, nonce=self.nonce, counter=self.counter, code=code
        )

    def _signed(self) -> tuple[str, bytes, bytes, bytes, bytes]:
        counter = self.counter.to_bytes(8, "little")
        return f"request {self.key}", self.nonce, counter, self.name.encode(), self.payload

    def is_signed_by(self, secret: bytes) -> bool:
        """Return True when `secret` signed it."""
        return verify_code(self.code, secret, *self._signed())

    def pack(self) -> bytes:
        """Return all but key and payload as an attachment."""
        return _STAMP.pack(self.nonce, self.counter, self.code) + self.name.encode()[:_MAX_NAME_BYTES]

    @staticmethod
    def unpack(key: str, payload: bytes, attachment: bytes) -> Request:
        """Return the request with this attachment.

        Raises:
            InvalidMessageError: the attachment is none of `pack` (`invalid_request`).
        """
        name = attachment[_STAMP.size :]
        try:
            if len(name) > _MAX_NAME_BYTES:
                raise ValueError("the name is too long")
            nonce, counter, code = _STAMP.unpack_from(attachment)
            return Request(key=key, payload=payload, name=name.decode(), nonce=nonce, counter=counter, code=code)
        except (struct.error, ValueError) as err:
            raise InvalidMessageError(
                f"bus: the attachment of a request to {key} is unreadable ({len(attachment)} bytes). Use the same "
                f"version on both ends.",
                code="invalid_request",
            ) from err


def sign_answer(secret: bytes, request: Request, kind: str, body: bytes) -> bytes:
    """Return `body`, an "answer" or an "error" to `request`, behind its code."""
    return compute_code(secret, f"{kind} {request.key}", request.nonce, body) + body


def open_answer(secret: bytes, request: Request, kind: str, data: bytes) -> bytes | None:
    """Return the body of an answer; None when the HAL did not sign it, or not for this request."""
    body = data[CODE_BYTES:]
    signed = verify_code(data[:CODE_BYTES], secret, f"{kind} {request.key}", request.nonce, body)
    return body if signed else None


@dataclass(frozen=True, slots=True, kw_only=True)
class LeaseGrant:
    """Answer to a claim."""

    owner: str
    """Owner of the lease: the client's name, with a suffix that the HAL drew."""
    secret: str = field(repr=False)
    """Secret that signs the owner's commands, in hexadecimal; for the claimant alone."""

    @staticmethod
    def draw(name: str) -> LeaseGrant:
        """Return a new grant for the client `name`."""
        return LeaseGrant(owner=f"{name}-{secrets.token_hex(4)}", secret=secrets.token_hex(32))

    @property
    def key(self) -> bytes:
        """The secret as bytes."""
        return bytes.fromhex(self.secret)

    def prove(self) -> bytes:
        """Return the payload of a claim by which the owner keeps its lease."""
        return compute_code(self.key, "claim again")


class LeaseAuthority:
    """The HAL's record of the newest grant and of the messages that counted, by which it knows the owner.

    Each key has one receiving thread; the claim's replaces the grant as a whole.
    """

    UNVERIFIED = "an unverified client"
    """Owner of a message that the grant's secret did not sign; no grant has this name."""

    def __init__(self) -> None:
        self._grant: LeaseGrant | None = None
        self._counters: dict[str, int] = {}
        self._claims: deque[bytes] = deque(maxlen=_CLAIMS_KEPT)

    def owner_of(self, request: Request) -> str:
        """Return the owner whose secret signed `request`, which counts once; else `UNVERIFIED`."""
        grant, counters = self._grant, self._counters
        if grant is None or not request.is_signed_by(grant.key) or request.counter <= counters.get(request.key, 0):
            return self.UNVERIFIED
        counters[request.key] = request.counter
        return grant.owner

    def check_claim(self, request: Request) -> None:
        """Check that a claim was not seen before.

        Raises:
            HalError: it was (`repeated_claim`).
        """
        if request.nonce in self._claims:
            raise HalError(
                "bus: this claim was made before. Claim the lease with a new request.", code="repeated_claim"
            )
        self._claims.append(request.nonce)

    def grant_for(self, request: Request) -> LeaseGrant:
        """Return the present grant when `request` proves it, else a new one, not yet in force."""
        grant = self._grant
        if grant is not None and hmac.compare_digest(request.payload, grant.prove()):
            return grant
        return LeaseGrant.draw(request.name)

    def put_in_force(self, grant: LeaseGrant) -> None:
        """Make `grant` the newest; a message signed by an earlier one is unverified from now on."""
        if grant is not self._grant:
            self._grant, self._counters = grant, {}
