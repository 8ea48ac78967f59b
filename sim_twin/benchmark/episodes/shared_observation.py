"""One observation of a scene, shared by all methods: they rank the same candidates."""

from __future__ import annotations

import numpy as np

from hal.base.messages import RgbdFrame
from models.types import GraspSet
from z1_runtime.collision.planning_scene import PlanningScene
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
        self._scene: PlanningScene | None = None
        self._scene_times = StageTimes()
        self._fitted: GraspCandidates | None = None
        self._filter_times = StageTimes()

    @classmethod
    def by(cls, selector: GraspSelector, frame: RgbdFrame, q: np.ndarray, times: StageTimes) -> SharedObservation:
        """Return observation and candidates of `selector` for `frame`, taken at joints `q` (7,); `times` gets the time.

        Raises:
            PerceptionError: nothing usable was detected.
            ValueError: the generator cannot use the cloud.
        """
        observation = selector.observe(frame, q, times)
        with times.stage("generate"):
            candidates = selector.generate(observation)
        return cls(frame, q, observation, candidates, times)

    def scene(self, selector: GraspSelector, times: StageTimes) -> PlanningScene:
        """Return the planning scene, built for the first method that needs it; `times` of each gets its `collision`."""
        if self._scene is None:
            with self._scene_times.stage("collision"):
                self._scene = selector.build_scene(self.observation, self.q)
        times.ms |= self._scene_times.ms
        return self._scene

    def fitted(self, selector: GraspSelector, times: StageTimes) -> GraspCandidates:
        """Return all candidates fitted to the gripper, for the first method that needs them.

        `times` of each method gets the stage `filter`.
        """
        scene = self.scene(selector, times)
        if self._fitted is None:
            with self._filter_times.stage("filter"):
                self._fitted = selector.fit_candidates(self.candidates, scene)
                self._fitted.free()
        times.ms |= self._filter_times.ms
        return self._fitted
