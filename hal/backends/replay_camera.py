"""Camera that replays recorded frames, and the format of their file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from hal.base.clock import Clock, WallClock
from hal.base.errors import CameraError, HalTimeoutError, NotConnectedError, UsageError
from hal.base.files import atomic_path, read_npz
from hal.base.messages import Intrinsics, RgbdFrame

_PERIOD_S = 1 / 30  # of the D405's default rate


class ReplayCamera:
    """Replay of frames at their recorded rate, with new stamps and sequence numbers.

    Args:
        frames: frames to replay; None = from `path`, or else the built-in scene.
        path: a file of `save_frames`.
        clock: source of time; None = wall clock.
        loop: start again after the last frame; else `wait_for_frame` times out there.

    Raises:
        CameraError: no frames, or frames of several cameras.
    """

    def __init__(
        self,
        frames: Sequence[RgbdFrame] | None = None,
        path: str | Path | None = None,
        clock: Clock | None = None,
        *,
        loop: bool = True,
    ) -> None:
        if frames is None:
            frames = load_frames(path) if path is not None else make_demo_frames()
        if not frames:
            raise CameraError(
                "replay camera: no frames to replay; record at least one with save_frames().", code="no_frames"
            )
        if any(frame.intrinsics != frames[0].intrinsics for frame in frames):
            raise CameraError(
                "replay camera: the frames have different intrinsics; record one camera at a time.",
                code="mixed_cameras",
            )
        self._frames = list(frames)
        self._clock = clock or WallClock()
        self._loop = loop
        # Due times from the recorded stamps; the last frame lasts as long as the median one.
        steps = np.diff([frame.stamp_s for frame in frames])
        self._length_s = float(np.median(steps)) if len(steps) and np.median(steps) > 0 else _PERIOD_S
        self._due_s = np.array([frame.stamp_s - frames[0].stamp_s for frame in frames])
        self._length_s += float(self._due_s[-1])
        self._start_s: float | None = None
        self._last = -1

    def connect(self) -> None:
        if self._start_s is None:
            self._start_s = self._clock.now_s()
            self._last = -1

    def disconnect(self) -> None:
        self._start_s = None

    @property
    def intrinsics(self) -> Intrinsics:
        self._require_start()
        return self._frames[0].intrinsics

    def wait_for_frame(self, timeout_s: float) -> RgbdFrame:
        start_s = self._require_start()
        now_s = self._clock.now_s()
        sequence = max(self._next_after(now_s - start_s), self._last + 1)
        loops, index = divmod(sequence, len(self._frames))
        due_s = start_s + loops * self._length_s + float(self._due_s[index])
        ended = not self._loop and loops > 0
        if ended or due_s > now_s + timeout_s:
            self._clock.sleep_until(now_s + timeout_s)
            reason = "the recording has ended" if ended else f"the next one is due in {due_s - now_s:.3f} s"
            raise HalTimeoutError(
                f"replay camera: no frame within {timeout_s} s: {reason}.",
                code="recording_ended" if ended else "no_frame",
            )
        self._clock.sleep_until(due_s)
        self._last = sequence
        return replace(self._frames[index], stamp_s=due_s, sequence=sequence)

    def _require_start(self) -> float:
        if self._start_s is None:
            raise NotConnectedError("the replay camera")
        return self._start_s

    def _next_after(self, played_s: float) -> int:
        loops, rest_s = divmod(played_s, self._length_s)
        index = int(np.searchsorted(self._due_s, rest_s, side="left"))
        return int(loops) * len(self._frames) + index


class RecordingError(CameraError, UsageError):
    """A file that holds no recorded frames."""


def save_frames(path: str | Path, frames: Sequence[RgbdFrame]) -> None:
    """Write frames of one camera into a compressed `.npz`.

    Raises:
        CameraError: no frames, or frames of several cameras.
    """
    if not frames or any(_device(frame) != _device(frames[0]) for frame in frames):
        raise CameraError(
            "replay camera: save_frames() takes at least one frame, all of one camera and the same intrinsics.",
            code="mixed_cameras" if frames else "no_frames",
        )
    arrays = {
        "colour": np.stack([frame.colour for frame in frames]),
        "depth_m": np.stack([frame.depth_m for frame in frames]),
        "stamp_s": np.array([frame.stamp_s for frame in frames]),
        "sequence": np.array([frame.sequence for frame in frames]),
        "serial": np.array(frames[0].serial),
    }
    masks = [frame.ground_truth_mask for frame in frames]
    if all(mask is not None for mask in masks):
        arrays["ground_truth_mask"] = np.stack([np.asarray(mask) for mask in masks])
    arrays |= {f"intrinsics_{name}": np.array(value) for name, value in asdict(frames[0].intrinsics).items()}
    with atomic_path(Path(path)) as partial, partial.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def _device(frame: RgbdFrame) -> tuple[Intrinsics, str]:
    return frame.intrinsics, frame.serial


def load_frames(path: str | Path) -> list[RgbdFrame]:
    """Return the frames in a file of `save_frames`.

    Raises:
        FileNotFoundError: no such file.
        RecordingError: the file holds no frames.
    """
    try:
        arrays = read_npz(Path(path))
        intrinsics = Intrinsics(
            width=int(arrays["intrinsics_width"]),
            height=int(arrays["intrinsics_height"]),
            **{name: float(arrays[f"intrinsics_{name}"]) for name in ("fx", "fy", "cx", "cy")},
        )
        masks = arrays.get("ground_truth_mask")
        serial = str(arrays.get("serial", ""))  # older recordings have none
        return [
            RgbdFrame(
                colour=colour,
                depth_m=arrays["depth_m"][i],
                intrinsics=intrinsics,
                stamp_s=float(arrays["stamp_s"][i]),
                sequence=int(arrays["sequence"][i]),
                serial=serial,
                ground_truth_mask=None if masks is None else masks[i],
            )
            for i, colour in enumerate(arrays["colour"])
        ]
    except (KeyError, ValueError, AttributeError, TypeError, IndexError, OverflowError) as error:
        raise RecordingError(
            f"replay camera: {path} holds no recorded frames ({error}); write it with save_frames().",
            code="not_a_recording",
        ) from error


def make_demo_frames(n: int = 4) -> list[RgbdFrame]:
    """Return `n` small frames of a ball above a plane, moving sideways, by ray casting."""
    intrinsics = Intrinsics(width=64, height=48, fx=60.0, fy=60.0, cx=31.5, cy=23.5)
    rays = intrinsics.rays()
    frames = []
    for i in range(n):
        centre = np.array([0.02 * (i - (n - 1) / 2), 0.0, 0.35])
        b = rays @ centre
        a = (rays**2).sum(axis=2)
        root = b**2 - a * (centre @ centre - 0.05**2)
        hit = root > 0
        depth_m = np.where(hit, (b - np.sqrt(np.maximum(root, 0))) / a, 0.5)
        colour = np.where(hit[..., None], (200, 60, 40), (120, 120, 120))
        frames.append(
            RgbdFrame(
                colour=colour.astype(np.uint8),
                depth_m=np.round(depth_m, 4),  # a D405's depth unit, 0.1 mm
                intrinsics=intrinsics,
                stamp_s=i * _PERIOD_S,
                sequence=i,
            )
        )
    return frames
