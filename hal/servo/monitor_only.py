"""Monitor-only servo: measures and publishes, and sends nothing to the arm."""

from __future__ import annotations

from hal.base.errors import CommandRejectedError, LeaseError
from hal.servo.control_loop import MonitorOnlyCycle
from hal.servo.servo import Servo

_MONITOR_ONLY = "servo: this HAL runs monitor-only (--readonly)"


class MonitorOnlyServo(Servo):
    """A servo whose ticks measure and publish only. Faults of the arm latch and are reported as usual."""

    cycle_type = MonitorOnlyCycle

    def claim(self, owner: str) -> None:
        """Reject every claim.

        Raises:
            LeaseError: always (`monitor_only`).
        """
        raise LeaseError(
            f"{_MONITOR_ONLY}: {owner!r} cannot claim the arm. Start it again without --readonly to move it.",
            code="monitor_only",
        )

    def stop(self, reason: str = "stop requested") -> None:
        """Reject a stop: another program moves the arm, which this servo cannot brake.

        Raises:
            CommandRejectedError: always (`monitor_only`).
        """
        raise CommandRejectedError(
            f"{_MONITOR_ONLY}: it cannot stop the arm ({reason}). Stop the program that moves it, or use the switch on "
            f"the arm.",
            code="monitor_only",
        )
