"""Queue between the task and a Rerun recording, so that logging never delays a motion."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hal.base.messages import ArmState, RgbdFrame, ServoStatus
from models.obb.obb import OrientedBox
from models.types import GraspSet
from z1_runtime.types import GraspPlan, Observation

if TYPE_CHECKING:  # an idle logger does not load Rerun
    from z1_runtime.collision.planning_scene import PlanningScene
    from z1_runtime.visualization.robot_view import Drawing

logger = logging.getLogger(__name__)

_Job = tuple[float, "Callable[[], Drawing]"]
"""Stamp [s] and the call that draws the entry."""


class RerunLogger:
    """Recording of a run, to a file, a live view, both, or neither.

    Calls only queue: a worker draws. Frames have a short queue of their own and are drawn last, so under load
    they are dropped first, oldest first (`frames_dropped`); other entries are lost only when thousands queue (`lost`).
    Times are the messages' own; entries without one get the newest so far.
    """

    def __init__(
        self,
        out: Path | None = None,
        live: bool = False,
        *,
        port: int = 9876,
        frame_rate_hz: float = 4.0,
        arm_rate_hz: float = 30.0,
        max_frames: int = 4,
        max_jobs: int = 4096,
    ) -> None:
        """Open the sinks; with neither `out` nor `live`, every call is ignored.

        Args:
            out: the .rrd file to write; its folder is made.
            live: serve on 127.0.0.1 and open the viewer if there is a screen.
            port: TCP port of the live view.
            frame_rate_hz: highest rate of frames; others are skipped and not counted as dropped.
            arm_rate_hz: highest rate of arm states.
            max_frames: capacity of the frame queue.
            max_jobs: capacity of the queue of other entries.

        Raises:
            recorder.ViewerPortError: another program listens on `port`.
        """
        self.frames_dropped = 0
        self.lost = 0
        self._frame_gap_s, self._arm_gap_s = 1.0 / frame_rate_hz, 1.0 / arm_rate_hz
        self._last_s = {"frame": -np.inf, "arm": -np.inf}
        self._newest_s = 0.0
        self._servo: tuple[Any, str] | None = None
        self._frames: deque[_Job] = deque()
        self._jobs: deque[_Job] = deque()
        self._max_frames, self._max_jobs = max_frames, max_jobs
        self._wake = threading.Condition()
        self._closing = False
        self._worker: threading.Thread | None = None
        if out is not None or live:
            from z1_runtime.visualization import archetypes
            from z1_runtime.visualization.recorder import Recorder

            self._archetypes = archetypes
            self._recorder = Recorder(out, port if live else None)
            self._worker = threading.Thread(target=self._work, name="rerun logger", daemon=True)
            self._worker.start()

    @property
    def active(self) -> bool:
        """True while entries are written to a file or a live view."""
        return self._worker is not None

    def log_frame(self, frame: RgbdFrame, T_base_camera: np.ndarray) -> None:
        """Log camera pose, colour and depth; `T_base_camera` (4, 4) at the time of the frame."""
        if self._is_due("frame", frame.stamp_s, self._frame_gap_s):
            self._put(frame.stamp_s, lambda: self._archetypes.draw_frame(frame, T_base_camera), is_frame=True)

    def log_observation(self, observation: Observation) -> None:
        """Log object and scene cloud; their frame is never dropped."""
        stamp_s = observation.frame.stamp_s
        self._put(stamp_s, lambda: self._archetypes.draw_frame(observation.frame, observation.T_base_camera))
        self._put(stamp_s, lambda: self._archetypes.draw_observation(observation))

    def log_planning_scene(self, scene: PlanningScene) -> None:
        """Log the obstacles of ranking and planning, and the occluded part of the object."""
        self._put(None, lambda: self._archetypes.draw_planning_scene(scene))

    def log_box(self, box: OrientedBox | None, faces: np.ndarray, T_base_camera: np.ndarray) -> None:
        """Log the box with the `faces` (k,) that may be approached; None clears it."""
        self._put(None, lambda: self._archetypes.draw_box(box, faces, T_base_camera))

    def log_candidates(self, grasps: GraspSet, T_base_camera: np.ndarray) -> None:
        """Log all candidates, coloured by score."""
        self._put(None, lambda: self._archetypes.draw_candidates(grasps, T_base_camera))

    def log_plan(self, plan: GraspPlan) -> None:
        """Log the chosen grasp and the pivot's path."""
        self._put(None, lambda: self._archetypes.draw_plan(plan, self._recorder.robot))

    def log_arm(self, state: ArmState, status: ServoStatus) -> None:
        """Log the robot, measured and commanded joints, and the servo's mode."""
        if (status.mode, status.reason) != self._servo:
            self._servo = (status.mode, status.reason)
            self._put(state.stamp_s, lambda: self._archetypes.draw_servo_change(status))
        if self._is_due("arm", state.stamp_s, self._arm_gap_s):
            self._put(state.stamp_s, lambda: self._archetypes.draw_arm(state, status, self._recorder.robot))

    def log_phase(self, name: str, t_s: float) -> None:
        """Log the start of the phase `name` at `t_s` [s]."""
        self._put(t_s, lambda: self._archetypes.draw_phase(name))

    def log_stage_times(self, stage_ms: Mapping[str, float]) -> None:
        """Log the duration of each stage [ms]."""
        # A copy: the worker draws it later
        times = dict(stage_ms)
        self._put(None, lambda: self._archetypes.draw_stage_times(times))

    def close(self, timeout_s: float = 5.0) -> None:
        """Write the queues, for at most about `timeout_s` [s], and close the sinks. Harmless when closed."""
        worker, self._worker = self._worker, None
        if worker is None:
            return
        with self._wake:
            self._closing = True
            self._wake.notify()
        worker.join(timeout_s)
        if worker.is_alive():
            logger.warning("the recording was not finished after %.1f s; it lacks the end", timeout_s)
        self._recorder.close(timeout_s)
        if self.frames_dropped or self.lost:
            logger.info("the recording dropped %d frames and lost %d entries", self.frames_dropped, self.lost)

    def _is_due(self, lane: str, stamp_s: float, gap_s: float) -> bool:
        if stamp_s - self._last_s[lane] < gap_s * (1.0 - 1e-6):  # rounding of stamps at exactly the rate
            return False
        self._last_s[lane] = stamp_s
        return True

    def _put(self, stamp_s: float | None, draw: Callable[[], Drawing], *, is_frame: bool = False) -> None:
        if self._worker is None:
            return
        with self._wake:
            stamp_s = self._newest_s if stamp_s is None else stamp_s
            self._newest_s = max(self._newest_s, stamp_s)
            if is_frame and len(self._frames) >= self._max_frames:
                self._frames.popleft()
                self.frames_dropped += 1
            elif not is_frame and len(self._jobs) >= self._max_jobs:
                self.lost += 1
                return
            (self._frames if is_frame else self._jobs).append((stamp_s, draw))
            self._wake.notify()

    def _work(self) -> None:
        try:
            self._recorder.write_static()
            while (job := self._next_job()) is not None:
                self._recorder.write(*job)
        except Exception:  # a fault in a drawing must not end a pick; the queues fill up and count the lost entries
            logger.exception("drawing failed; the recording ends here")

    def _next_job(self) -> _Job | None:
        with self._wake:
            self._wake.wait_for(lambda: self._jobs or self._frames or self._closing)
            lane = self._jobs or self._frames  # frames last, so that under load they are the ones dropped
            return lane.popleft() if lane else None
