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
"""Empty, signed by the lease's secret, from the owner of the lease, 50 Hz."""

HELLO = "srv/hello"
"""Handshake: answers with a `hal.bus.codec.Hello` once everything runs."""
CLAIM = "srv/claim"
"""Answers with a `hal.bus.authentication.LeaseGrant`, whose secret signs every command and heartbeat."""
RELEASE = "srv/release"
CHUNK = "srv/chunk"
"""Takes a `TrajectoryChunk`; the answer is empty, or the error that rejects it."""
SEND = "srv/send"
"""Takes an `ArmSetpoint`; answers with the one applied."""
STOP = "srv/stop"
"""Takes the reason in UTF-8, from every client."""
REARM = "srv/rearm"
"""Answers with the `ServoStatus` afterwards."""
READ_STATUS = "srv/status"
"""Answers with the `ServoStatus` of this moment."""

COMMANDS = (CLAIM, RELEASE, CHUNK, SEND, REARM)
"""Services that need an operator's role."""
QUESTIONS = (HELLO, STOP, READ_STATUS)
"""Services for every client."""
SERVICES = (*QUESTIONS, *COMMANDS)
PUBLISHED = (STATE, STATUS, HEALTH, FRAME)
"""Topics of the HAL."""
EVALUATION = "eval"
"""Root of the twin's services for evaluation, which its HAL process serves as a client of its own."""
