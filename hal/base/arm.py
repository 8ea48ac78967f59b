"""What an arm is to the rest of the system: six joints and the gripper as the seventh."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from hal.base.messages import ArmSetpoint, ArmState, ServoStatus, TrajectoryChunk


@runtime_checkable
class Arm(Protocol):
    """An arm that takes one setpoint a tick. Nothing here is safe by itself: see `hal.servo.servo.Servo`."""

    def connect(self) -> None:
        """Open the link; the arm holds still. A failed connect leaves nothing open.

        Raises:
            HalTimeoutError: nobody answers.
        """
        ...

    def disconnect(self) -> None:
        """Close the link; the arm holds where it is. Harmless when not connected."""
        ...

    def read_state(self) -> ArmState:
        """Return the newest measurement.

        Raises:
            NotConnectedError: before `connect()`.
            HalTimeoutError: the newest measurement is too old to be trusted.
        """
        ...

    def send(self, setpoint: ArmSetpoint) -> ArmSetpoint:
        """Hand over the next setpoint; return what was really applied after the backend's limits.

        Raises:
            NotConnectedError: before `connect()`.
            CommandRejectedError: the arm will not take it.
        """
        ...

    def stop(self) -> None:
        """Stop at once and hold; callable at any time, from any thread."""
        ...


@runtime_checkable
class ServoedArm(Arm, Protocol):
    """An arm with the servo above it: takes trajectories, owns the lease, latches the stop.

    `hal.servo.servo.Servo` is one in this process, `hal.bus.client.RemoteArm` is the same one over Zenoh.
    """

    def claim(self, owner: str) -> None:
        """Take the command lease.

        Raises:
            LeaseError: somebody else holds it; the message names the holder.
        """
        ...

    def release(self) -> None:
        """Give the lease back; a running motion is braked first. Harmless when not held."""
        ...

    def stream(self, chunk: TrajectoryChunk) -> None:
        """Queue a piece of a trajectory.

        Raises:
            StoppedError: the stop is latched.
            LeaseError: the lease is not ours.
            CommandRejectedError: it starts too far from the arm, breaks a limit, or leaves a gap in time.
        """
        ...

    def status(self) -> ServoStatus:
        """Return the servo's newest account of itself."""
        ...

    def rearm(self) -> None:
        """Lift a latched stop; the arm holds where it is and the lease is free."""
        ...
