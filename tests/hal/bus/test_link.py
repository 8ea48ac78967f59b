"""Both ends of the link in one process, over real Zenoh sessions."""

from __future__ import annotations

import ctypes
import logging
from threading import Event, Thread

import numpy as np
import pytest

from hal.base.arm import ServoedArm
from hal.base.camera import Camera
from hal.base.clock import WallClock
from hal.base.errors import (
    CommandRejectedError,
    HalError,
    HalTimeoutError,
    InvalidMessageError,
    LeaseError,
    NotConnectedError,
    StoppedError,
)
from hal.base.messages import ArmSetpoint, ServoMode, ServoStatus, TrajectoryChunk
from hal.base.z1 import Q_HOME
from hal.bus import keys
from hal.bus.authentication import CODE_BYTES, Request
from hal.bus.client import RemoteArm, RemoteCamera
from hal.bus.codec import decode, encode
from hal.bus.error_codec import decode_error
from hal.bus.frames import FrameBuffers
from hal.bus.service import Listener, as_bytes
from hal.bus.session import BusConfig, open_session
from tests.support.errors import raises
from tests.support.faults_table import FaultsTable, describe
from tests.support.hal.bus_hal import moving, slow_motion, wait_until

pytestmark = pytest.mark.integration

HOME = np.append(Q_HOME, 0.0)


# --- The arm ------------------------------------------------------------------------------------------------------


def test_the_remote_devices_satisfy_the_contracts(remote_arm, remote_camera):
    assert isinstance(remote_arm, ServoedArm)
    assert isinstance(remote_camera, Camera)


def test_before_connect_every_call_raises_and_disconnect_has_no_effect():
    arm = RemoteArm()
    setpoint = ArmSetpoint(q=HOME, dq=np.zeros(7))
    calls = [arm.read_state, arm.stop, arm.claim, arm.release, arm.status, arm.rearm]
    for call in [*calls, lambda: arm.send(setpoint), lambda: arm.stream(slow_motion())]:
        with pytest.raises(NotConnectedError):
            call()
    arm.disconnect()


def test_a_trajectory_is_played_to_its_end(hal, remote_arm):
    remote_arm.claim()
    chunk = slow_motion(duration_s=0.8)
    remote_arm.stream(chunk)
    status = wait_until(lambda: (s := remote_arm.status()).finished and s)
    assert status.trajectory_id == chunk.trajectory_id
    assert status.mode is ServoMode.HOLDING
    np.testing.assert_allclose(status.q_command, chunk.q[-1], atol=1e-6)
    wait_until(lambda: abs(remote_arm.read_state().q[0] - chunk.q[-1, 0]) < 1e-3)


def test_a_status_requested_after_a_chunk_describes_that_chunk(remote_arm):
    remote_arm.claim()
    for trajectory_id in (1, 2):
        chunk = TrajectoryChunk(
            trajectory_id=trajectory_id,
            t_s=np.array([0.0, 0.1]),
            q=np.array([HOME, HOME]),
            dq=np.zeros((2, 7)),
            final=True,
        )
        remote_arm.stream(chunk)
        wait_until(lambda i=trajectory_id: remote_arm.status().trajectory_id == i and remote_arm.status().finished)


def test_send_returns_the_applied_setpoint(remote_arm):
    remote_arm.claim()
    far = HOME + np.array([1.0, 0, 0, 0, 0, 0, 0])
    applied = remote_arm.send(ArmSetpoint(q=far, dq=np.zeros(7)))
    assert 0 < applied.q[0] < 0.1


@pytest.mark.faults
def test_the_lease_names_its_owner_to_the_second_client_and_can_be_transferred(
    hal, remote_arm, faults_table: FaultsTable
):
    with RemoteArm(hal.config, owner="rival") as rival:
        remote_arm.claim()
        with raises(LeaseError, "owned_by_other") as rejected:
            rival.claim()
        assert "tester-" in str(rejected.value)
        faults_table.add("second client of the HAL", arm="follows the first client only", reads=rejected.value)
        with raises(LeaseError, "owned_by_other"):
            rival.stream(slow_motion())
        rival.release()
        assert remote_arm.status().owner.startswith("tester-")
        remote_arm.release()
        rival.claim()
        assert remote_arm.status().owner.startswith("rival-")


def test_two_clients_of_one_name_are_two_owners(hal, remote_arm):
    remote_arm.claim("twin")
    with RemoteArm(hal.config, owner="tester") as other, raises(LeaseError, "owned_by_other"):
        other.claim("twin")


def test_the_heartbeat_sustains_a_motion_far_beyond_the_servos_timeout(remote_arm):
    remote_arm.claim()
    remote_arm.stream(slow_motion(duration_s=1.0))
    wait_until(lambda: moving(remote_arm))
    assert wait_until(lambda: (s := remote_arm.status()).mode is not ServoMode.TRACKING and s).finished


@pytest.mark.faults
def test_disconnecting_in_motion_brakes_and_frees_the_lease(hal, remote_arm, faults_table: FaultsTable):
    remote_arm.claim()
    remote_arm.stream(slow_motion())
    wait_until(lambda: moving(hal.servo))
    gone_s, q = WallClock().now_s(), hal.arm.read_state().q
    remote_arm.disconnect()
    status = wait_until(lambda: (s := hal.servo.status()).mode is ServoMode.HOLDING and s)
    assert not status.finished
    assert status.owner == ""
    faults_table.add(
        "client gone, in order",
        arm=describe(status, hal.arm.read_state().q - q),
        rest_s=status.stamp_s - gone_s,
        reads=status.reason,
    )


def test_rejections_cross_the_link_with_class_and_code(remote_arm):
    with raises(LeaseError, "not_claimed"):
        remote_arm.stream(slow_motion())
    remote_arm.claim()
    far = TrajectoryChunk(trajectory_id=1, t_s=np.array([0.0, 1.0]), q=np.full((2, 7), -0.5), dq=np.zeros((2, 7)))
    with raises(CommandRejectedError, "start_jump"):
        remote_arm.stream(far)
    remote_arm.stop("enough")
    with raises(StoppedError, "stopped"):
        remote_arm.stream(slow_motion())


def test_a_stop_from_a_second_client_holds_until_rearmed(hal, remote_arm):
    remote_arm.claim()
    remote_arm.stream(slow_motion())
    wait_until(lambda: moving(hal.servo))
    with RemoteArm(hal.config, owner="bystander") as bystander:
        bystander.stop("a hand came near")
        stopped = wait_until(lambda: (s := hal.servo.status()).mode is ServoMode.STOPPED and s)
        assert stopped.reason == "a hand came near"
        for attempt in (
            lambda: remote_arm.stream(slow_motion(2)),
            lambda: remote_arm.send(ArmSetpoint(q=HOME, dq=HOME)),
        ):
            with raises(StoppedError, "stopped"):
                attempt()
        np.testing.assert_array_equal(hal.servo.status().q_command, stopped.q_command)
        bystander.rearm()
    remote_arm.claim()
    q = hal.servo.status().q_command
    remote_arm.stream(
        TrajectoryChunk(trajectory_id=2, t_s=np.array([0.0, 0.1]), q=np.array([q, q]), dq=np.zeros((2, 7)), final=True)
    )
    wait_until(lambda: remote_arm.status().finished)


def test_a_stop_is_executed_while_another_query_is_stuck(hal, remote_arm, monkeypatch):
    stuck, unblock = Event(), Event()

    def slow_rearm(owner: str | None = None) -> None:
        stuck.set()
        unblock.wait(5.0)

    monkeypatch.setattr(hal.servo, "rearm", slow_rearm)
    with RemoteArm(hal.config) as other:
        errors: list[HalTimeoutError] = []

        def request() -> None:
            try:
                other.rearm()
            except HalTimeoutError as error:
                errors.append(error)

        requesting = Thread(target=request)
        requesting.start()
        assert stuck.wait(10)
        remote_arm.stop("now")
        wait_until(lambda: hal.servo.status().reason == "now", 3.0)
        assert requesting.is_alive() or errors
        requesting.join()
        assert errors[0].code == "no_answer"
        unblock.set()


def test_an_arm_that_stops_measuring_makes_the_remote_state_too_old(hal, remote_arm):
    remote_arm.read_state()
    hal.arm.freeze()

    def too_old() -> bool:
        try:
            remote_arm.read_state()
        except HalTimeoutError as error:
            return error.code == "stale_state"
        return False

    wait_until(too_old)


def test_the_status_of_an_arm_that_stops_measuring_is_still_published(hal, intruder):
    newest: list[bytes] = []
    listener = Listener(intruder, keys.STATUS, lambda sample: newest.append(as_bytes(sample.payload)))
    hal.arm.freeze()
    wait_until(lambda: newest and decode(newest[-1], ServoStatus).mode is ServoMode.STOPPED)
    newest.clear()
    wait_until(lambda: newest)
    assert "state is lost" in decode(newest[-1], ServoStatus).reason
    listener.close()


def test_a_hal_process_that_ends_gives_typed_errors(hal, remote_arm):
    remote_arm.claim()
    hal.server.close()
    with raises(HalTimeoutError, "no_hal"):
        remote_arm.stream(slow_motion())
    with raises(HalTimeoutError, "no_hal"):
        remote_arm.stop()
    remote_arm.disconnect()


# --- The camera ---------------------------------------------------------------------------------------------------


def test_a_frame_is_one_exposed_after_the_call_and_none_is_lost_on_the_way(remote_camera):
    clock = WallClock()
    sequences = []
    for _ in range(5):
        began_s = clock.now_s()
        frame = remote_camera.wait_for_frame(2.0)
        assert frame.stamp_s >= began_s
        assert frame.intrinsics == remote_camera.intrinsics
        sequences.append(frame.sequence)
    assert sequences == sorted(set(sequences))
    assert remote_camera.lost_frames == 0
    assert len(remote_camera.frame_latencies_ms) == 5
    assert 0 < remote_camera.frame_latency_ms(50) <= remote_camera.frame_latency_ms(99)


def test_frames_arrive_pixel_by_pixel_through_shared_memory_and_without(hal):
    originals = {}
    take = hal.camera.wait_for_frame

    def remember(timeout_s):
        frame = take(timeout_s)
        originals[frame.sequence] = frame
        return frame

    hal.camera.wait_for_frame = remember
    for shared in (True, False):
        config = BusConfig(port=hal.config.port, shared_memory=shared)
        with RemoteCamera(config) as camera:
            frame = camera.wait_for_frame(2.0)
            assert camera.shared_memory is shared
            np.testing.assert_array_equal(frame.colour, originals[frame.sequence].colour)
            np.testing.assert_array_equal(frame.depth_m, originals[frame.sequence].depth_m)


def test_the_camera_is_only_read_while_a_client_listens(hal):
    reads = []
    take = hal.camera.wait_for_frame
    hal.camera.wait_for_frame = lambda timeout_s: (reads.append(1), take(timeout_s))[1]
    with RemoteArm(hal.config):
        Event().wait(0.3)
        assert reads == []
    with RemoteCamera(hal.config) as camera:
        camera.wait_for_frame(2.0)
        assert reads
        wait_until(lambda: _pauses(reads))
        # ... and starts again for the next wait.
        count = len(reads)
        camera.wait_for_frame(2.0)
        assert len(reads) > count


def _pauses(reads: list) -> bool:
    count = len(reads)
    Event().wait(0.3)
    return len(reads) == count


def test_threads_that_wait_at_once_all_get_the_next_frame(hal, remote_camera):
    # The camera delivers a single frame: every waiting thread must get it.
    take, waiting = hal.camera.wait_for_frame, Event()
    wait_until(lambda: remote_camera._listener is None)

    def one(timeout_s):
        waiting.wait()
        hal.camera.wait_for_frame = lambda _: _silence()
        return take(timeout_s)

    hal.camera.wait_for_frame = one
    frames: list[int] = []
    threads = [Thread(target=lambda: frames.append(remote_camera.wait_for_frame(5.0).sequence)) for _ in range(3)]
    for thread in threads:
        thread.start()
    wait_until(lambda: remote_camera._waiting == len(threads))
    waiting.set()
    for thread in threads:
        thread.join()
    assert len(frames) == 3
    assert len(set(frames)) == 1


def test_a_thread_that_waits_for_a_frame_gets_an_error_when_the_camera_is_disconnected(hal, remote_camera):
    wait_until(lambda: remote_camera._listener is None)
    hal.camera.wait_for_frame = lambda timeout_s: _silence()
    errors: list[Exception] = []

    def wait() -> None:
        try:
            remote_camera.wait_for_frame(60.0)
        except NotConnectedError as error:
            errors.append(error)

    thread = Thread(target=wait)
    thread.start()
    wait_until(lambda: remote_camera._waiting)
    remote_camera.disconnect()
    thread.join()
    assert errors


def _silence():
    Event().wait(0.05)
    raise HalTimeoutError("the cable is out")


def test_a_silent_camera_is_a_timeout(hal, remote_camera):
    hal.camera.wait_for_frame = lambda timeout_s: _silence()
    Event().wait(0.1)
    with raises(HalTimeoutError, "no_frame"):
        remote_camera.wait_for_frame(0.3)


def test_a_gap_in_the_sequence_is_counted(hal, remote_camera):
    take = hal.camera.wait_for_frame
    hal.camera.wait_for_frame = lambda timeout_s: (take(timeout_s), take(timeout_s), take(timeout_s))[2]
    wait_until(lambda: remote_camera.wait_for_frame(2.0) and remote_camera.lost_frames >= 2)


def test_without_space_in_shared_memory_frames_are_sent_as_bytes_with_one_warning(hal, monkeypatch, caplog):
    class Full:
        f_bavail, f_frsize = 0, 4096

    monkeypatch.setattr("hal.bus.frames.os.statvfs", lambda _: Full)
    with caplog.at_level(logging.WARNING):
        buffers = FrameBuffers(hal.camera.intrinsics, shared=True)
    assert not buffers.shared
    assert len(caplog.records) == 1
    frame = hal.camera.wait_for_frame(1.0)
    assert buffers.fill(frame) == encode(frame)


# --- Malformed and foreign messages ---------------------------------------------------------------------------------

GARBAGE = [b"", b"\x00" * 8, b"not a message", encode(ArmSetpoint(q=HOME, dq=HOME))[:-3], b"\xff" * 5000]


@pytest.fixture
def intruder(hal):
    with open_session(hal.config, listen=False) as session:
        yield session


@pytest.mark.parametrize("payload", GARBAGE)
@pytest.mark.parametrize("key", [keys.CHUNK, keys.SEND])
def test_a_malformed_command_gets_one_error_and_moves_nothing(hal, remote_arm, intruder, key, payload):
    remote_arm.claim()
    q = hal.servo.status().q_command
    attachment = Request.make(b"", key, payload, remote_arm.status().owner, 1).pack()
    (reply,) = list(intruder.get(key, payload=payload, attachment=attachment, timeout=5.0))
    error = decode_error(reply.err.payload.to_bytes()[CODE_BYTES:])
    assert type(error) is InvalidMessageError
    status = hal.servo.status()
    assert status.mode is ServoMode.HOLDING
    np.testing.assert_array_equal(status.q_command, q)
    assert not hal.server.failed.is_set()


def test_an_oversized_command_is_dropped_by_the_transport(hal, remote_arm, intruder):
    replies = list(intruder.get(keys.CHUNK, payload=bytes(20 * 2**20), timeout=0.5))
    assert all(reply.err.payload.to_bytes() == b"Timeout" for reply in replies)  # Zenoh's own, if anything
    remote_arm.stop("still served")
    wait_until(lambda: hal.servo.status().mode is ServoMode.STOPPED)
    assert not hal.server.failed.is_set()


def test_an_unreadable_request_is_rejected_everywhere_but_at_the_stop(hal, intruder):
    for key in keys.SERVICES:
        (reply,) = list(intruder.get(key, payload=b"\xff", attachment=b"\xff\xfe", timeout=5.0))
        if key == keys.STOP:
            assert reply.ok is not None
        else:
            assert type(decode_error(reply.err.payload.to_bytes()[CODE_BYTES:])) is InvalidMessageError
    wait_until(lambda: hal.servo.status().mode is ServoMode.STOPPED)
    assert "stop requested" in hal.servo.status().reason


@pytest.mark.parametrize(("key", "size"), [(keys.CHUNK, 3 * 2**20), (keys.SEND, 100_000), (keys.CLAIM, 100_000)])
def test_a_message_far_too_long_for_its_key_reaches_no_service(hal, intruder, key, size):
    handled: list[str] = []
    for service in hal.server._services:
        service._handle = lambda request: handled.append(request.key) or b""
    assert not [reply for reply in intruder.get(key, payload=bytes(size), timeout=0.3) if reply.ok]
    (reply,) = list(intruder.get(keys.STOP, payload=b"a short one", timeout=5.0))
    assert reply.ok is not None
    assert handled == [keys.STOP]


def test_a_stop_with_a_long_reason_arrives(hal, remote_arm):
    remote_arm.stop("ü" * 100_000)
    wait_until(lambda: hal.servo.status().mode is ServoMode.STOPPED)


def test_malformed_requests_in_great_number_write_few_lines(hal, intruder, caplog):
    with caplog.at_level(logging.WARNING):
        for _ in range(40):
            for key in (keys.CLAIM, keys.STOP):
                list(intruder.get(key, payload=b"\xff" * 3000, timeout=5.0))
    for text in ("malformed", "unreadable reason"):
        assert 1 <= sum(text in record.getMessage() for record in caplog.records) <= 5


def test_an_unforeseen_error_is_the_error_of_one_request(hal, remote_arm, monkeypatch):
    def broken_claim(owner: str) -> None:
        raise ZeroDivisionError("on purpose")

    with monkeypatch.context() as broken:
        broken.setattr(hal.servo, "claim", broken_claim)
        with raises(HalError, "internal"):
            remote_arm.claim()
    remote_arm.claim()
    assert not hal.server.failed.is_set()


def test_undecodable_states_are_ignored(hal, remote_arm, monkeypatch):
    good = remote_arm.read_state()
    put = hal.server._put

    def put_garbage(publisher, key, payload):
        put(publisher, key, b"no state" if key == keys.STATE else payload)

    monkeypatch.setattr(hal.server, "_put", put_garbage)

    def too_old() -> bool:
        try:
            assert remote_arm.read_state().stamp_s >= good.stamp_s
        except HalTimeoutError as error:
            return error.code == "stale_state"
        return False

    wait_until(too_old)


def test_a_call_that_blocked_the_interpreter_does_not_make_the_state_stale(hal, remote_arm):
    sleep_holding_the_gil = ctypes.PyDLL(None).usleep
    sleep_holding_the_gil(int(1e6 * (0.2 + hal.config.state_max_age_s)))
    assert remote_arm.read_state().q.shape == (7,)
