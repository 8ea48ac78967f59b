"""`pyrealsense2` with a digital twin for a camera: `import hal.realsense as rs`, and the code stays as it was.

All of it is librealsense itself. With nothing plugged in by `plug`, its classes see the real cameras on USB; with a
twin plugged in, they see the twin alone, as a D405 through librealsense's own `software_device`.
"""

from hal.realsense.library import *  # noqa: F403 - every public name of pyrealsense2

# isort: split
import sys

from hal.realsense.api import config as config
from hal.realsense.api import context as context
from hal.realsense.api import frame_queue as frame_queue
from hal.realsense.api import pipeline as pipeline
from hal.realsense.api import pipeline_wrapper as pipeline_wrapper
from hal.realsense.device import SERIAL as SERIAL
from hal.realsense.device import TwinDevice as TwinDevice
from hal.realsense.library import __full_version__ as __full_version__
from hal.realsense.library import __version__ as __version__
from hal.realsense.port import masquerade as masquerade
from hal.realsense.port import plug as plug
from hal.realsense.port import plugged as plugged
from hal.realsense.port import unplug as unplug

pyrealsense2 = sys.modules[__name__]  # `from pyrealsense2 import pyrealsense2` is this module too
