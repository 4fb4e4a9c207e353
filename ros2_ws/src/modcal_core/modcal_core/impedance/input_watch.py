"""Whether joint states, wrench and object status of a pull are fresh, and how long they are waited for.

A pull waits for a late input with the last setpoint standing. After ``patience`` it is over, and what is held is to be
let go, for which joint states are needed. Where they are the input that is missing, a servo holds on to where it was
sent last, so the release is kept pending: joint states that return within some seconds begin it.
"""

from __future__ import annotations

import math

# s: a driver that is restarted publishes again within that; later somebody may have moved the arm, and must not be met
# by one that moves by itself
_RECOVERY_TIME = 5.0
NO_STATUS = "object_status: no recent message: check that articulation_estimator is alive and its input too"


class InputWatch:
    """Watch over the inputs of one pull. timeout: oldest input that is used [s]. pending: why to let go once joint
    states return, or "".
    """

    def __init__(self, timeout: float) -> None:
        """Nothing is late yet."""
        self.timeout = timeout
        self.pending = ""
        self._late_since = math.nan  # s
        self._moving_since = math.inf  # s

    def start_motion(self, now: float) -> None:
        """The hand moves from ``now`` [s] on, and the object's status is needed."""
        self._moving_since = now

    def fresh(self, stamp: float, now: float) -> bool:
        """Whether an input of this stamp [s] can be used."""
        return abs(now - stamp) <= self.timeout

    def late(self, now: float, stamps: dict[str, float]) -> str:
        """Which of the inputs, by name and stamp [s], is late, as text; empty where none is."""
        for what, stamp in stamps.items():
            if not self.fresh(stamp, now):
                return f"{what}: no message in the last {self.timeout:g} s: check that its publisher is alive"
        return ""

    def estimator_lost(self, silent: bool, now: float, patience: float) -> str:
        """Why the hand must not be led on: the object's status is silent, and not for being about to begin; or empty.

        silent: whether no recent status was received. patience: what the estimator has for its first one [s].
        """
        if silent and now - self._moving_since > patience:
            return NO_STATUS
        return ""

    def wait(self, now: float) -> None:
        """Something is late at this time [s]."""
        if math.isnan(self._late_since):
            self._late_since = now

    def all_fresh(self) -> None:
        """Nothing is late any more."""
        self._late_since, self.pending = math.nan, ""

    def waited(self, now: float, patience: float) -> bool:
        """Whether something was waited for longer than this [s], or the clock moved backwards meanwhile."""
        return not math.isnan(self._late_since) and not 0.0 <= now - self._late_since <= patience

    def recoverable(self, now: float) -> bool:
        """Whether joint states that return now [s] may still begin the release."""
        return 0.0 <= now - self._late_since <= _RECOVERY_TIME
