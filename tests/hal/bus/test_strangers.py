"""Forged messages over real loopback sessions: none moves, stops, frees or deceives anybody."""

from __future__ import annotations

import json
import os
from threading import Event

import numpy as np
import pytest
import zenoh

from hal.base.clock import WallClock
from hal.base.errors import HalError, LeaseError
from hal.base.messages import ArmSetpoint, ArmState, ServoMode, TrajectoryChunk
from hal.bus import keys
from hal.bus.authentication import CODE_BYTES, Request, compute_code
from hal.bus.client import RemoteArm, RemoteCamera
from hal.bus.codec import Hello, decode, encode
from hal.bus.error_codec import decode_error
from hal.bus.frames import FrameStamp
from hal.bus.runtime_files import make_secret, read_secret
from hal.bus.session import open_session, zenoh_settings
from tests.support.errors import raises
from tests.support.hal.bus_hal import HOME, free_config, moving, slow_motion, wait_until

pytestmark = pytest.mark.integration


@pytest.fixture
def stranger(hal):
    """A session of a program without the link's secret."""
    with open_session(hal.config, listen=False) as session:
        yield session


def ask(session: zenoh.Session, request: Request) -> bytes | HalError:
    """Return the unsigned body of the answer to `request`, or its error."""
    replies = session.get(request.key, payload=request.payload, attachment=request.pack(), timeout=5.0)
    (reply,) = list(replies)
    if reply.ok is not None:
        return reply.ok.payload.to_bytes()[CODE_BYTES:]
    return decode_error(reply.err.payload.to_bytes()[CODE_BYTES:])


def forged(key: str, payload: bytes, owner: str, secret: bytes | None = None) -> Request:
    return Request.make(secret, key, payload, owner, 2**40)


@pytest.mark.parametrize("by", ["no secret", "another secret", "the link's secret"])
def test_forged_commands_in_the_owners_name_have_no_effect(hal, remote_arm, stranger, by):
    secret = {"no secret": None, "another secret": os.urandom(32), "the link's secret": read_secret(hal.config.port)}[
        by
    ]
    remote_arm.claim()
    owner = remote_arm.status().owner
    chunk, setpoint = encode(slow_motion()), encode(ArmSetpoint(q=HOME + 0.01, dq=np.zeros(7)))
    for key, payload in ((keys.CHUNK, chunk), (keys.SEND, setpoint), (keys.REARM, b"")):
        error = ask(stranger, forged(key, payload, owner, secret))
        assert isinstance(error, LeaseError)
        assert error.code == "owned_by_other"
    assert ask(stranger, forged(keys.RELEASE, b"", owner, secret)) == b""
    status = remote_arm.status()
    assert status.owner == owner
    assert status.mode is ServoMode.HOLDING
    assert status.trajectory_id == 0


def test_a_stranger_cannot_claim_or_ask(hal, stranger):
    for key in (keys.CLAIM, keys.READ_STATUS, keys.HELLO):
        error = ask(stranger, forged(key, b"", "stranger", os.urandom(32)))
        assert isinstance(error, LeaseError)
        assert error.code == "unverified_client"
    assert hal.servo.status().owner == ""


def test_a_stop_needs_no_secret_and_rearm_needs_the_lease(hal, remote_arm, stranger):
    remote_arm.claim()
    assert ask(stranger, forged(keys.STOP, b"a stranger", "x")) == b""
    wait_until(lambda: hal.servo.status().mode is ServoMode.STOPPED)
    for secret in (None, read_secret(hal.config.port)):
        error = ask(stranger, forged(keys.REARM, b"", remote_arm.status().owner, secret))
        assert isinstance(error, LeaseError)
    assert hal.servo.status().mode is ServoMode.STOPPED
    with RemoteArm(hal.config, owner="operator") as operator:
        operator.rearm()
    wait_until(lambda: hal.servo.status().mode is ServoMode.HOLDING)
    assert hal.servo.status().owner == ""


def test_rearm_from_a_client_without_the_lease_is_rejected_while_nothing_is_stopped(hal, remote_arm):
    remote_arm.claim()
    with RemoteArm(hal.config, owner="rival") as rival, raises(LeaseError, "owned_by_other"):
        rival.rearm()
    assert remote_arm.status().owner.startswith("tester-")


def test_the_status_holds_nothing_that_signs(hal, remote_arm):
    remote_arm.claim()
    grant = remote_arm._heartbeat.grant
    status, health = encode(remote_arm.status()), encode(hal.servo.health())
    for secret in (grant.secret.encode(), grant.key, read_secret(hal.config.port)):
        assert secret not in status + health
    assert grant.secret not in repr(grant)


def test_a_repeated_message_of_the_owner_has_no_effect(hal, remote_arm, stranger):
    link_secret = read_secret(hal.config.port)
    claim = Request.make(link_secret, keys.CLAIM, b"", "recorded", 1)
    grant = decode(ask(stranger, claim))
    # Shorter than the heartbeat's timeout, which no client sends here.
    t_s, q = np.array([0.0, 0.05]), np.array([HOME, HOME])
    stay = TrajectoryChunk(trajectory_id=1, t_s=t_s, q=q, dq=np.zeros((2, 7)), final=True)
    chunk = Request.make(grant.key, keys.CHUNK, encode(stay), grant.owner, 1)
    release = Request.make(grant.key, keys.RELEASE, b"", grant.owner, 2)
    assert ask(stranger, chunk) == b""
    wait_until(lambda: hal.servo.status().finished)
    assert isinstance(ask(stranger, chunk), LeaseError)
    assert ask(stranger, release) == b""
    remote_arm.claim()
    for recorded in (claim, chunk, release):
        ask(stranger, recorded)
    assert hal.servo.status().owner.startswith("tester-")
    remote_arm.release()
    assert isinstance(repeated := ask(stranger, claim), HalError)
    assert repeated.code == "repeated_claim"
    assert hal.servo.status().owner == ""


def test_forged_and_repeated_heartbeats_sustain_no_motion(hal, remote_arm, stranger):
    remote_arm.claim()
    heartbeat = remote_arm._heartbeat
    recorded = remote_arm._link.sign_heartbeat(heartbeat.grant)
    remote_arm.stream(slow_motion())
    wait_until(lambda: moving(hal.servo))
    owner = remote_arm.status().owner
    heartbeat.stop()
    beats = (recorded, forged(keys.HEARTBEAT, b"", owner).pack(), owner.encode(), b"", b"\xff" * 200)

    def braked() -> bool:
        for beat in beats:
            stranger.put(keys.HEARTBEAT, owner.encode(), attachment=beat)
        return hal.servo.status().mode is ServoMode.HOLDING

    wait_until(braked)
    assert "heartbeat" in hal.servo.status().reason
    assert not hal.server.failed.is_set()


def test_a_rogue_state_is_neither_forwarded_nor_taken(hal, remote_arm, stranger):
    nearly = hal.servo.read_state()
    far = ArmState(stamp_s=nearly.stamp_s + 60.0, q=nearly.q + 1.0, dq=nearly.dq, tau=nearly.tau)
    payload = encode(far)
    heard: list[bytes] = []
    receive = remote_arm._states._on_sample
    remote_arm._states._on_sample = lambda sample: (heard.append(sample.payload.to_bytes()), receive(sample))
    for attachment in (b"", bytes(CODE_BYTES), compute_code(os.urandom(32), keys.STATE, payload)):
        stranger.put(keys.STATE, payload, attachment=attachment)
    count = len(heard)
    wait_until(lambda: len(heard) > count + 20)
    assert payload not in heard  # the HAL's access control dropped it
    assert abs(remote_arm.read_state().q[0] - nearly.q[0]) < 0.1


@pytest.mark.parametrize("mode", ["client", "peer", "router"])
def test_a_rogue_service_gets_no_request(hal, mode):
    settings = zenoh_settings(hal.config, listen=False, shared_memory=False) | {"mode": mode}
    stranger = zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))
    asked: list[str] = []

    def answer(query: zenoh.Query) -> None:
        asked.append(str(query.key_expr))
        query.reply(query.key_expr, b"rogue")

    rogues = [stranger.declare_queryable(key, answer, complete=True) for key in (*keys.SERVICES, "**")]
    listener = stranger.declare_subscriber("**", lambda sample: asked.append(str(sample.key_expr)))
    with RemoteArm(hal.config, owner="victim") as victim:
        victim.claim()
        victim.stop("in earnest")
        wait_until(lambda: hal.servo.status().mode is ServoMode.STOPPED)
        assert hal.servo.status().reason == "in earnest"
        victim.rearm()
    assert [key for key in asked if key not in keys.PUBLISHED] == []
    for declared in (*rogues, listener):
        declared.undeclare()
    stranger.close()


@pytest.mark.parametrize("device", [RemoteArm, RemoteCamera])
def test_an_impostor_of_the_hal_is_recognised(device):
    config = free_config(connect_timeout_s=0.5)
    make_secret(config.port)  # of a HAL that has ended
    hello = encode(Hello(robot=config.robot, versions=(), now_s=WallClock().now_s()))
    with open_session(config, listen=True) as session:
        service = session.declare_queryable(
            keys.HELLO, lambda query: query.reply(keys.HELLO, bytes(CODE_BYTES) + hello)
        )
        with raises(HalError, "unverified_hal"):
            device(config).connect()
        service.undeclare()


def test_states_and_frames_of_an_impostor_are_dropped_after_the_hal_has_ended(hal, remote_arm, remote_camera):
    hal.server.close()
    state = encode(ArmState(stamp_s=WallClock().now_s() + 60.0, q=HOME + 1.0, dq=HOME, tau=HOME))
    stamp = FrameStamp(sent_s=1.0, exposed_s=1e9, sequence=1).pack()
    arrived = Event()
    drop = remote_arm._dropped.warning
    remote_arm._dropped.warning = lambda *words: (arrived.set(), drop(*words))
    with open_session(hal.config, listen=True) as impostor:

        def publish() -> bool:
            impostor.put(keys.STATE, state, attachment=compute_code(os.urandom(32), keys.STATE, state))
            impostor.put(keys.FRAME, b"", attachment=stamp + bytes(CODE_BYTES))
            return arrived.is_set()

        wait_until(publish)  # Zenoh connects the client to whatever listens at the address
        assert remote_arm._newest.stamp_s < decode(state).stamp_s
        with pytest.raises(HalError):
            remote_arm.stop()
        assert remote_camera._newest is None or remote_camera._newest[0].exposed_s < 1e9
