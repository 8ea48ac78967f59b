"""Key expressions of the link, all below one Zenoh namespace per robot, which keeps two robots apart."""

from __future__ import annotations

STATE = "state"
"""`ArmState`, from the HAL, about 100 Hz."""
STATUS = "status"
"""`ServoStatus`, from the HAL, with each state."""
HEALTH = "health"
"""`ServoHealth`, from the HAL, once a second."""
FRAME = "frame"
"""`RgbdFrame`, from the HAL, only while a client listens; the attachment is a `hal.bus.frames.FrameStamp`."""
HEARTBEAT = "heartbeat"
"""The owner's name in UTF-8, from the owner of the lease, 50 Hz."""

HELLO = "srv/hello"
"""Handshake: answers with a `hal.bus.codec.Hello` once everything runs."""
CLAIM = "srv/claim"
RELEASE = "srv/release"
CHUNK = "srv/chunk"
"""Takes a `TrajectoryChunk`; the answer is empty, or the error that rejects it."""
SEND = "srv/send"
"""Takes an `ArmSetpoint`; answers with the one applied."""
STOP = "srv/stop"
"""Takes the reason in UTF-8."""
REARM = "srv/rearm"
READ_STATUS = "srv/status"
"""Answers with the `ServoStatus` of this moment."""

SERVICES = (HELLO, CLAIM, RELEASE, CHUNK, SEND, STOP, REARM, READ_STATUS)
