"""Streams planned motions to the servo, a fifth of a second ahead, and notices when one does not arrive."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hal import z1
from hal.arm import ServoedArm
from hal.clock import Clock
from hal.messages import ArmState, ServoStatus, TrajectoryChunk
from z1_runtime.types import JointTrajectory


class MotionError(RuntimeError):
    """A motion was begun and not finished; the arm has braked and holds."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ExecutorConfig:
    """How trajectories are handed over."""

    lead_s: float = 0.2
    """How much motion waits at the servo [s]; a dead runtime moves the arm no longer than this."""
    chunk_s: float = 0.1
    """Length of one message [s]."""
    poll_s: float = 0.02
    """How often the servo is asked how far it is [s]."""
    settle_dq: float = 0.02
    """Joint speed that counts as rest [rad/s]."""
    settle_timeout_s: float = 3.0
    """How long a motion may take to come to rest after its end [s]."""

    def __post_init__(self) -> None:
        if not 0 < self.poll_s < self.chunk_s < self.lead_s:
            raise ValueError(
                f"ExecutorConfig needs 0 < poll_s < chunk_s < lead_s; got {self.poll_s}, {self.chunk_s}, {self.lead_s}."
            )


Watcher = Callable[[ArmState, ServoStatus], None]


class Executor:
    """Plays trajectories on a `ServoedArm` whose lease is held."""

    def __init__(self, arm: ServoedArm, clock: Clock, config: ExecutorConfig | None = None) -> None:
        self._arm = arm
        self._clock = clock
        self._config = config or ExecutorConfig()
        self.watchers: list[Watcher] = []
        """Called with the arm's state every poll, for logs; must return at once."""

    def execute(self, trajectory: JointTrajectory) -> None:
        """Play `trajectory` to its end; return when the servo has sent its last point.

        Raises:
            CommandRefusedError: the servo will not take it (stopped, wrong start, limits, lease).
            MotionError: it was dropped on the way; the message carries the servo's reason.
        """
        config = self._config
        trajectory_id = self._arm.status().trajectory_id + 1
        pieces = list(trajectory.pieces(config.chunk_s))
        sent_s = 0.0
        while True:
            status = self._look()
            ours = status.trajectory_id == trajectory_id
            if ours and status.finished:
                return
            if ours and status.reason:
                raise MotionError(
                    f"the motion was dropped {status.trajectory_time_s:.2f} s into {trajectory.duration_s:.2f} s: "
                    f"{status.reason}; the arm holds."
                )
            played_s = status.trajectory_time_s if ours else 0.0
            while pieces and sent_s - played_s < config.lead_s:
                piece = pieces.pop(0)
                self._arm.stream(_chunk(trajectory, piece, trajectory_id, final=not pieces))
                sent_s = float(trajectory.t_s[piece.stop - 1])
            self._clock.sleep_until(self._clock.now_s() + config.poll_s)

    def settle(self) -> ArmState:
        """Wait until no joint moves; return that state.

        Raises:
            MotionError: it does not come to rest in time.
        """
        deadline_s = self._clock.now_s() + self._config.settle_timeout_s
        quiet = 0
        while True:
            self._clock.sleep_until(self._clock.now_s() + self._config.poll_s)
            self._look()
            state = self._arm.read_state()
            quiet = quiet + 1 if np.abs(state.dq).max() < self._config.settle_dq else 0
            if quiet >= 3:
                return state
            if self._clock.now_s() > deadline_s:
                joint = int(np.abs(state.dq).argmax())
                raise MotionError(
                    f"{z1.JOINT_NAMES[joint]} still moves at {state.dq[joint]:.3f} rad/s, "
                    f"{self._config.settle_timeout_s} s after the motion; rest is {self._config.settle_dq} rad/s."
                )

    def _look(self) -> ServoStatus:
        status = self._arm.status()
        if self.watchers:
            state = self._arm.read_state()
            for watch in self.watchers:
                watch(state, status)
        return status


def _chunk(trajectory: JointTrajectory, piece: slice, trajectory_id: int, *, final: bool) -> TrajectoryChunk:
    return TrajectoryChunk(
        trajectory_id=trajectory_id,
        t_s=trajectory.t_s[piece],
        q=trajectory.q[piece],
        dq=trajectory.dq[piece],
        final=final,
    )
