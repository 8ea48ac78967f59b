"""`pyrealsense2` with a digital twin as a camera: `import hal.compat.realsense as rs`, without other changes.

All of it is librealsense itself. Without a twin plugged in by `plug`, its classes find the real cameras on USB; with
one, they find only the twin, as a D405 through librealsense's own `software_device`.
"""

from hal.compat.realsense.library import *  # noqa: F403 - every public name of pyrealsense2

# isort: split
import sys

from hal.compat.realsense.api import config as config
from hal.compat.realsense.api import context as context
from hal.compat.realsense.api import frame_queue as frame_queue
from hal.compat.realsense.api import pipeline as pipeline
from hal.compat.realsense.api import pipeline_wrapper as pipeline_wrapper
from hal.compat.realsense.device import SERIAL as SERIAL
from hal.compat.realsense.device import TwinDevice as TwinDevice
from hal.compat.realsense.library import __full_version__ as __full_version__
from hal.compat.realsense.library import __version__ as __version__
from hal.compat.realsense.port import masquerade as masquerade
from hal.compat.realsense.port import plug as plug
from hal.compat.realsense.port import plugged as plugged
from hal.compat.realsense.port import unplug as unplug

pyrealsense2 = sys.modules[__name__]  # `from pyrealsense2 import pyrealsense2` is this module too
