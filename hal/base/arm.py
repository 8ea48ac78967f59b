"""Contracts of an arm: six joints, and the gripper as the seventh."""

from __future__ import annotations

from typing import NamedTuple, Protocol, runtime_checkable

from hal.base.messages import ArmSetpoint, ArmState, ServoStatus, TrajectoryChunk


@runtime_checkable
class Arm(Protocol):
    """An arm that takes one setpoint a tick. It has no safety functions of its own: see `hal.servo.servo.Servo`."""

    def connect(self) -> None:
        """Open the link; the arm holds still. A failed connect leaves nothing open.

        Raises:
            HalTimeoutError: the arm does not answer.
        """
        ...

    def disconnect(self) -> None:
        """Close the link; the arm holds its position. No effect when not connected."""
        ...

    def read_state(self) -> ArmState:
        """Return the newest measurement.

        Raises:
            NotConnectedError: before `connect()`.
            HalTimeoutError: the newest measurement is too old.
        """
        ...

    def send(self, setpoint: ArmSetpoint) -> ArmSetpoint:
        """Send the next setpoint; return the one applied after the backend's limits.

        Raises:
            NotConnectedError: before `connect()`.
            CommandRejectedError: the arm does not accept it.
        """
        ...

    def stop(self) -> None:
        """Stop at once and hold; callable at any time, from any thread."""
        ...


class CommandLatency(NamedTuple):
    """Time from sending a command to the answer to it, over the last half minute [ms]; zeros while unmeasured."""

    p50_ms: float = 0.0
    p99_ms: float = 0.0
    max_ms: float = 0.0


@runtime_checkable
class TimedArm(Protocol):
    """An arm that measures the latency of its commands."""

    def command_latency(self) -> CommandLatency:
        """Return the latency; for any thread, at any time."""
        ...


@runtime_checkable
class ServoedArm(Arm, Protocol):
    """An arm with the servo above it: plays trajectories, grants the lease, latches the stop.

    `hal.servo.servo.Servo` is one in this process; `hal.bus.client.RemoteArm` is one in the HAL process, over Zenoh.
    """

    def claim(self, owner: str) -> None:
        """Claim the command lease.

        Raises:
            LeaseError: another client owns it; the message names the owner.
        """
        ...

    def release(self) -> None:
        """Release the lease and brake a running motion. No effect when not owned."""
        ...

    def stream(self, chunk: TrajectoryChunk) -> None:
        """Queue a trajectory chunk.

        Raises:
            StoppedError: the stop is latched.
            LeaseError: the caller does not own the lease.
            GuardError: it leaves the workspace.
            CommandRejectedError: it starts too far from the arm, breaks a limit, or leaves a gap in time.
        """
        ...

    def status(self) -> ServoStatus:
        """Return the servo's present status."""
        ...

    def rearm(self) -> None:
        """Clear a latched stop; the arm holds its position and the lease is free."""
        ...
