"""A servo that only watches: it measures and tells, and commands nothing, whoever asks."""

from __future__ import annotations

from hal.base.errors import CommandRejectedError, LeaseError
from hal.servo.control_loop import MonitorOnlyCycle
from hal.servo.servo import Servo

_WHY = "this HAL only watches (--readonly) and commands nothing"


class MonitorOnlyServo(Servo):
    """A servo whose ticks measure, publish, and no more. What the arm reports latches as usual, and is told."""

    cycle_type = MonitorOnlyCycle

    def claim(self, owner: str) -> None:
        """Refuse.

        Raises:
            LeaseError: always.
        """
        raise LeaseError(f"{_WHY}; {owner!r} cannot have the arm. Start it again without --readonly to move it.")

    def stop(self, reason: str = "stop requested") -> None:
        """Refuse: whoever moves the arm, it is not this servo.

        Raises:
            CommandRejectedError: always.
        """
        raise CommandRejectedError(
            f"{_WHY}, so it cannot stop the arm ({reason}): stop whoever moves it, or use the switch on the arm."
        )
