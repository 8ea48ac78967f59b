"""One observation of a scene, shared by all methods: they rank the same candidates."""

from __future__ import annotations

import numpy as np

from hal.base.messages import RgbdFrame
from models.types import GraspSet
from z1_runtime.collision.scene_collision import CollisionChecker
from z1_runtime.grasping.grasp_candidates import GraspCandidates
from z1_runtime.tasks.grasp_selection import GraspSelector, StageTimes
from z1_runtime.types import Observation


class SharedObservation:
    """A frame with its observation and the generator's candidates.

    Args:
        frame: as the camera gave it.
        q: (7,) joints it was taken at [rad].
        observation: clouds and table.
        candidates: camera frame.
        times: of detect, cloud and generate.
    """

    def __init__(
        self, frame: RgbdFrame, q: np.ndarray, observation: Observation, candidates: GraspSet, times: StageTimes
    ) -> None:
        self.frame, self.q = frame, q
        self.observation, self.candidates = observation, candidates
        self.times = times
        self._free: np.ndarray | None = None
        self._filter_times = StageTimes()

    @classmethod
    def by(cls, decider: GraspSelector, frame: RgbdFrame, q: np.ndarray, times: StageTimes) -> SharedObservation:
        """Return observation and candidates of `decider` for `frame`, taken at joints `q` (7,); `times` gets the time.

        Raises:
            PerceptionError: nothing usable was detected.
            ValueError: the generator cannot use the cloud.
        """
        observation = decider.observe(frame, q, times)
        with times.stage("generate"):
            candidates = decider.propose(observation)
        return cls(frame, q, observation, candidates, times)

    def free(self, decider: GraspSelector, times: StageTimes) -> np.ndarray:
        """Return (N,) which candidates the gripper can be placed on without collision with the observed points.

        The first call computes it; `times` of every call gets its duration as the stage `filter`.
        """
        if self._free is None:
            with self._filter_times.stage("filter"):
                planner = decider.planner
                checker = CollisionChecker(decider.kinematics, self.observation, self.q, planner.config.collision)
                self._free = GraspCandidates(
                    self.candidates,
                    self.observation.T_base_camera,
                    planner.gripper,
                    checker,
                    fallback_width_m=planner.config.fallback_width_m,
                ).free()
        times.ms |= self._filter_times.ms
        return self._free
