"""Pacing of the commands by the controller's answers, and the latency at which it reads them.

The controller reads one datagram per cycle of about 2.03 ms, first in, first out (measured): commands sent faster queue
up in its socket and are obeyed up to 0.41 s late. Two unanswered ones keep it supplied, and their answers come in the
order of the commands, which identifies them although no answer has a number.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from hal.base.arm import CommandLatency

MAX_UNANSWERED = 2
"""Commands on their way, unread or unanswered."""
MAX_LATENCY_S = 0.05
"""Latency above which commands are too late for an arm [s]: half of the maximum age of an answer."""

# Four of the controller's cycles: a live one has answered everything that reached it by then.
_QUIET_S = 0.008
_MAX_PROBE_S = 0.1
_MAX_TRACKED = 64
_RECENT = 16
_LATE_COUNT = 3  # one late answer may be a hiccup of this machine or of the controller's
_CAPACITY = 15_000  # half a minute of answers


class CommandPacer:
    """Accounting of the commands sent and the answers received.

    Commands that are lost on the way are recognised by quiet: an answer has come since the last command, and then none
    for four cycles, or for longer than the last answers took where they were late.
    """

    def __init__(self) -> None:
        self.sent = 0
        """Number of the last command sent; the first is 1."""
        self.answered = 0
        """Number of the last command that was answered, or is known to be lost."""
        self.unsolicited = 0
        """Answers to no command of this driver."""
        self._unanswered: deque[tuple[int, float]] = deque()
        self._recent_s: deque[float] = deque([0.0], maxlen=_RECENT)
        self._active_s = -np.inf  # of the last command or answer
        self._answered_since_sent = False
        self._probe_s = _QUIET_S
        self._ring_ms = np.zeros(_CAPACITY)
        self._measured = 0
        self._late_count = 0
        self.late_s = 0.0
        """Latency of the last three answers, when each was above `MAX_LATENCY_S` for certain [s]; otherwise 0."""

    @property
    def unanswered(self) -> int:
        """Commands without an answer."""
        return len(self._unanswered)

    def may_send(self, now_s: float) -> bool:
        """Return whether a command may leave at `now_s` [s] without queueing up in the controller's socket."""
        if len(self._unanswered) < MAX_UNANSWERED:
            return True
        quiet_s = now_s - self._active_s
        late_s = max(self._recent_s)
        if self._answered_since_sent and quiet_s >= (_QUIET_S if late_s < MAX_LATENCY_S else 1.2 * late_s):
            self.forget()
            return True
        # Without any answer the controller is busy, gone, or everything was lost: probe at growing intervals, since a
        # busy one will have to read all of it.
        if quiet_s < self._probe_s:
            return False
        self._probe_s = min(2.0 * self._probe_s, _MAX_PROBE_S)
        return True

    def forget(self) -> None:
        """Regard the unanswered commands as lost."""
        if self._unanswered:
            self.answered = self._unanswered[-1][0]
            self._unanswered.clear()

    def record_command(self, now_s: float) -> None:
        """Record a command that was sent at `now_s` [s]."""
        self.sent += 1
        self._unanswered.append((self.sent, now_s))
        if len(self._unanswered) > _MAX_TRACKED:
            self.answered = self._unanswered.popleft()[0]
        self._active_s, self._answered_since_sent = now_s, False

    def record_answer(self, now_s: float, empty_s: float) -> None:
        """Record an answer.

        Args:
            now_s: time at which it was read from the socket [s].
            empty_s: last time before at which the socket was empty [s]: the answer came after it.
        """
        self._active_s, self._answered_since_sent, self._probe_s = now_s, True, _QUIET_S
        if not self._unanswered:
            self.unsolicited += 1
            return
        self.answered, sent_s = self._unanswered.popleft()
        self._ring_ms[self._measured % _CAPACITY] = 1e3 * (now_s - sent_s)
        self._measured += 1
        # Where this process was late to look, only the time until it last looked in vain is the controller's.
        certain_s = empty_s - sent_s
        self._recent_s.append(certain_s)
        self._late_count = self._late_count + 1 if certain_s > MAX_LATENCY_S else 0
        self.late_s = certain_s if self._late_count >= _LATE_COUNT else 0.0

    def summary(self) -> CommandLatency:
        """Return percentiles of the latency over the last half minute."""
        measured_ms = self._ring_ms[: min(self._measured, _CAPACITY)].copy()
        if not len(measured_ms):
            return CommandLatency()
        ranks = [round(quantile * (len(measured_ms) - 1)) for quantile in (0.5, 0.99, 1.0)]
        return CommandLatency(*np.partition(measured_ms, ranks)[ranks].tolist())
