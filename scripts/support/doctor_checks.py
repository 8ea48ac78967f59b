"""Checks of `./z1 doctor`: each inspects one part of the machine, changes nothing, and has a time limit."""

from __future__ import annotations

import errno
import os
import platform
import shutil
import socket
import subprocess
import sys
from dataclasses import dataclass
from enum import Enum
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hal.bus.session import BusConfig

ROOT = Path(__file__).resolve().parents[2]
ARM_ADDRESS = "192.168.123.110"
"""The vendor's address of a Z1's board."""

# Without ultralytics, which a distributor may leave out (see NOTICE).
_MODULES = [
    "numpy",
    "scipy",
    "numba",
    "open3d",
    "trimesh",
    "pinocchio",
    "ssik",
    "ruckig",
    "mujoco",
    "cv2",
    "torch",
    "zenoh",
    "msgpack",
    "rerun",
    "tyro",
    "rich",
    "yaml",
    "PIL",
]
_LIMITS_FILE = "/etc/security/limits.d/z1.conf"


class State(Enum):
    """Result of a check."""

    OK = "ok"
    WARN = "warn"
    """Works, with a restriction."""
    MISSING = "missing"


@dataclass(frozen=True)
class Check:
    """One row of the table."""

    name: str
    state: State
    found: str
    """Finding on this machine."""
    fix: str = ""
    """Command or action that fixes it."""


def check_python() -> Check:
    version = platform.python_version()
    # The range of pyproject.toml; pyrealsense2 has wheels up to 3.14.
    if (3, 11) <= sys.version_info[:2] <= (3, 14):
        return Check("python", State.OK, f"{version}, {sys.executable}")
    return Check("python", State.MISSING, version, "sudo apt install python3.11, then rm -rf .venv and ./z1 --version")


def check_packages() -> Check:
    missing = [name for name in _MODULES if find_spec(name) is None]
    if missing:
        return Check("packages", State.MISSING, f"not installed: {', '.join(missing)}", "rm -rf .venv; ./z1 --version")
    return Check("packages", State.OK, f"all {len(_MODULES)} found")


def check_usb_library() -> Check:
    from hal.libusb import preload

    return Check("libusb", State.OK, preload())


def check_processors() -> Check:
    # The cores that this process may use, such as a container's; not every system has the call.
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    found = f"{usable} cores, {platform.machine()}"
    if usable < 2:
        return Check("processor", State.WARN, found, "use a machine with two cores: the 500 Hz servo loop needs one")
    return Check("processor", State.OK, found)


def check_memory() -> Check:
    total_gb = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    if total_gb < 3.5:  # a machine of 4 GB reports less than 4
        return Check("memory", State.WARN, f"{total_gb:.1f} GB", "4 GB or more are recommended")
    return Check("memory", State.OK, f"{total_gb:.1f} GB")


def check_shared_memory() -> Check:
    free_mb = shutil.disk_usage("/dev/shm").free / 1e6
    fix = "sudo mount -o remount,size=256M /dev/shm (in a container: --shm-size=256m)"
    if free_mb < 64:
        return Check("shared memory", State.WARN, f"{free_mb:.0f} MB free; images need 64", fix)
    return Check("shared memory", State.OK, f"{free_mb:.0f} MB free")


def check_disk() -> Check:
    free_gb = shutil.disk_usage(ROOT).free / 1e9
    if free_gb < 0.2:  # ten runs
        return Check("disk", State.MISSING, f"{free_gb:.2f} GB free", "free disk space: a run writes about 20 MB")
    return Check("disk", State.OK, f"{free_gb:.0f} GB free")


def check_bus_port() -> Check:
    from hal.bus.session import BusConfig

    config = BusConfig(connect_timeout_s=0.5)
    check = _check_port(
        "Zenoh port", config.port, f"end the program that uses it, or: ./z1 demo --port {config.port + 1}"
    )
    if check.state is State.OK or not (health := _our_hal(config)):
        return check
    found = f"{config.port} is used by a HAL process of this project (robot {config.robot!r}): {health}"
    return Check(
        "Zenoh port",
        State.WARN,
        found,
        f"use it with ./z1 run; for the demo end it, or: ./z1 demo --port {config.port + 1}",
    )


def _our_hal(config: BusConfig) -> str:
    """Return the health of a HAL process of this project on that port; empty if there is none."""
    from hal.base.clock import WallClock
    from hal.base.errors import HalError
    from hal.bus.health import describe_health, wait_for_health

    try:
        return describe_health(wait_for_health(config, WallClock()))
    except HalError:
        return ""


def check_viewer_port() -> Check:
    return _check_port("viewer port", 9876, "close the other live view")  # Rerun's default


def check_graphics() -> Check:
    program = (
        "from mujoco.egl import GLContext; c = GLContext(64, 64); c.make_current(); from OpenGL import GL; "
        "print(GL.glGetString(GL.GL_RENDERER).decode())"
    )
    fix = "sudo apt install libegl1 libgl1-mesa-dri (until then the twin's camera uses ray casting, with flat colours)"
    code, out = _run_python(program, timeout_s=20.0, MUJOCO_GL="egl", PYOPENGL_PLATFORM="egl")
    if code != 0:
        return Check("graphics", State.WARN, f"no OpenGL through EGL: {_last_line(out)}", fix)
    software = any(word in out.lower() for word in ("llvmpipe", "softpipe", "swrast"))  # Mesa's renderers on the CPU
    return Check("graphics", State.OK, f"EGL, {_last_line(out)}{' (software)' if software else ''}")


def check_gpu() -> Check:
    if shutil.which("nvidia-smi") is None:
        return Check("GPU", State.OK, "none; not needed")
    command = ["nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=False)
    if done.returncode != 0:
        return Check("GPU", State.WARN, _last_line(done.stdout + done.stderr), "check the NVIDIA driver; not needed")
    return Check("GPU", State.OK, done.stdout.strip().replace("\n", "; "))


def check_detector() -> Check:
    from models.detector.runtimes import installed_runtimes
    from models.detector.weights import detector_path
    from models.weights_file import WeightsError

    runtimes = installed_runtimes()
    if not runtimes:
        return Check(
            "detector", State.WARN, "no runtime", "uv sync --extra fast-detector; until then: --detector tabletop"
        )
    try:
        ms = {runtime: _detector_ms(runtime) for runtime in runtimes}
    except WeightsError as error:
        fix = f"restore models/weights/{detector_path().name}; until then: --detector tabletop"
        return Check("detector", State.WARN, str(error), fix)
    used, best = runtimes[0], min(ms, key=lambda name: ms[name])
    found = ", ".join(f"{name} {ms[name]:.0f} ms" for name in runtimes) + f"; {used} is used"
    if ms[used] > 1.3 * ms[best]:
        return Check("detector", State.WARN, found, f"yolo: {{runtime: {best}}} in the configuration (--config)")
    return Check("detector", State.OK, found)


def _detector_ms(runtime: str) -> float:
    """Return the median time of a detection in an image of 640 x 480 [ms]."""
    from statistics import median

    import numpy as np

    from hal.base.clock import Stopwatch
    from models.detector.detector import YoloConfig, YoloModel

    detector, image = YoloModel(YoloConfig(runtime=runtime)), np.full((480, 640, 3), 127, np.uint8)
    watch, times = Stopwatch(), []  # the median leaves out the first runs, which load and compile
    for _ in range(9):
        watch.lap_ms()
        detector.detect(image)
        times.append(watch.lap_ms())
    return median(times)


def check_real_time() -> Check:
    import resource

    _, highest = resource.getrlimit(resource.RLIMIT_RTPRIO)
    # 80 is the servo thread's SCHED_FIFO priority
    if highest == resource.RLIM_INFINITY or highest >= 80 or os.geteuid() == 0:
        return Check("real-time rights", State.OK, "root" if os.geteuid() == 0 else f"priority up to {highest}")
    fix = _limits_fix("rtprio 90")
    return Check("real-time rights", State.WARN, f"priority up to {highest}: the servo loop shares its core", fix)


def check_locked_memory() -> Check:
    import resource

    from hal.servo.servo_thread import may_lock_memory

    if may_lock_memory():
        return Check("locked memory", State.OK, "unlimited")
    _, highest = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    found = f"up to {highest / 1e6:.0f} MB, and the servo needs unlimited: it may wait for the disk"
    fix = f"{_limits_fix('memlock unlimited')} (in a container: --ulimit memlock=-1)"
    return Check("locked memory", State.WARN, found, fix)


def check_camera() -> Check:
    program = (
        "from hal.libusb import preload; preload(); import pyrealsense2 as rs; "
        "print('; '.join(d.get_info(rs.camera_info.name) + ' ' + d.get_info(rs.camera_info.serial_number) "
        "for d in rs.context().query_devices()))"
    )
    code, out = _run_python(program, timeout_s=15.0)
    if code != 0:
        return Check(
            "camera", State.MISSING, _last_line(out), "not needed for the twin; see `./z1 doctor` on Linux x86"
        )
    if not out.strip():
        fix = "not needed for the twin; plug the D405 into a USB 3 port and install librealsense's udev rules"
        return Check("camera", State.MISSING, "no RealSense on USB", fix)
    return Check("camera", State.OK, out.strip())


def check_arm() -> Check:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((ARM_ADDRESS, 9))  # a UDP connect sends nothing, and finds the route; port 9 is discard
            ours = probe.getsockname()[0]
        except OSError:
            ours = "no route"
    if not ours.startswith("192.168.123."):
        fix = "not needed for the twin; sudo ip address add 192.168.123.162/24 dev <the arm's network port>"
        return Check("arm", State.MISSING, f"not configured: this machine has no address near {ARM_ADDRESS}", fix)
    if _is_there(ARM_ADDRESS):
        return Check("arm", State.OK, f"{ARM_ADDRESS} answers {ours}")
    return Check("arm", State.MISSING, f"{ARM_ADDRESS} does not answer", "switch the arm on; check the cable")


def _is_there(address: str) -> bool:
    # A closed TCP port answers too. The arm's UDP port is not probed: a datagram there could be a command.
    with socket.socket() as probe:
        probe.settimeout(0.5)
        code = probe.connect_ex((address, 9))
    return code in (0, errno.ECONNREFUSED)


def _limits_fix(right: str) -> str:
    return f"echo '{os.environ.get('USER', '<you>')} - {right}' | sudo tee -a {_LIMITS_FILE}, then log in again"


def _check_port(name: str, port: int, fix: str) -> Check:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # a port whose last user has just ended is free
        try:
            probe.bind(("127.0.0.1", port))
        except OSError as error:
            return Check(name, State.MISSING, f"{port} is taken: {error.strerror}", fix)
    return Check(name, State.OK, f"{port} is free")


def _run_python(program: str, timeout_s: float, **environment: str) -> tuple[int, str]:
    """Run `program` in a process of its own, as drivers may hang or crash it; return exit code and output."""
    try:
        done = subprocess.run(
            [sys.executable, "-P", "-c", program],  # -P: no module of the working directory
            capture_output=True,
            text=True,
            timeout=timeout_s,
            check=False,
            env={**os.environ, **environment},
        )
    except subprocess.TimeoutExpired:
        return 1, f"no answer within {timeout_s:.0f} s"
    return done.returncode, done.stdout if done.returncode == 0 else done.stderr


def _last_line(text: str) -> str:
    return (text.strip().splitlines() or ["no message"])[-1][:200]
