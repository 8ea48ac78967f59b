"""Measure rate, latency and processor time of the D405's driver with the twin's frames through librealsense.

    .venv/bin/python -m scripts.measure.measure_camera --seconds 20

In free run at 30 Hz: frames per second, the age of a frame at delivery, and processor time of the whole process; then
the same in lock-step, at full speed.
"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass

import numpy as np
import tyro

from hal.backends.d405.camera import D405Camera
from hal.backends.d405.session import D405CameraConfig
from hal.base.clock import WallClock
from sim_twin.drop_in.realsense_source import TwinSource
from sim_twin.model.scene import SceneConfig
from sim_twin.model.world import World


@dataclass(frozen=True, kw_only=True)
class Config:
    """Duration and image size."""

    seconds: float = 10.0
    """Duration of the free run [s]."""
    width: int = 640
    """Image width [px]."""
    height: int = 480
    """Image height [px]."""


def main(config: Config) -> None:
    """Measure and print."""
    print(f"{config.width}×{config.height}, load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    world = World(SceneConfig())
    settings = D405CameraConfig(width=config.width, height=config.height)
    clock = WallClock()
    with TwinSource(world, clock) as source:
        source.warm_up(config.width, config.height)
        camera = D405Camera(settings, source=source)
        camera.connect()
        numbers, ages_s, cpu_s, start_s = [], [], time.process_time(), clock.now_s()
        while clock.now_s() < start_s + config.seconds:
            frame = camera.wait_for_frame(5.0)
            numbers.append(frame.sequence)
            ages_s.append(clock.now_s() - frame.stamp_s)
        cpu_s, passed_s = time.process_time() - cpu_s, clock.now_s() - start_s
        health = camera.health
        camera.disconnect()
    ages_ms = 1e3 * np.percentile(ages_s, [50, 99])
    missed = numbers[-1] - numbers[0] + 1 - len(numbers)
    print(f"free run   {len(numbers) / passed_s:5.1f} frames/s, {missed} missed of {missed + len(numbers)}, {health}")
    print(f"           age at delivery {ages_ms[0]:.1f} ms (p99 {ages_ms[1]:.1f}), {cpu_s / passed_s:.0%} of a core")
    with TwinSource(world) as source:
        camera = D405Camera(settings, source=source)
        camera.connect()
        count, cpu_s, start_s = 50, time.process_time(), clock.now_s()
        for _ in range(count):
            camera.wait_for_frame(1.0)
        cpu_s, passed_s = time.process_time() - cpu_s, clock.now_s() - start_s
        camera.disconnect()
    print(f"lock-step  {count / passed_s:5.1f} frames/s, {1e3 * cpu_s / count:.1f} ms of processor/frame, with physics")


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
