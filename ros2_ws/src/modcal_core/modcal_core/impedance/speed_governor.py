"""How fast to go on along a path, and whether anything moves at all.

A force that rises slows the pace down: full speed up to ``slowdown``, none from ``stop`` on. At a hard stop that comes
too late: the force grows by K v, with K the stiffness of hand and arm in series, for the delay T until what is felt has
been understood, sent and done, and for the way v²/2a in which it brakes at a. Before that, the arm's mass m runs into
the contact, of stiffness C. So

    F + v √(C m) + K (v T + v²/2a) ≤ F_last,        Ḟ = K v.

The first says how fast it may be before anything is felt. The second says what a rising force will have come to, F + Ḟ
(T + v/2a), without K; that is the force which the pace answers.

C is what was stated only where a touch, the first of which comes slowly, shows no more (:meth:`SpeedGovernor.touch`);
else it is that of steel. A force sensor may fall silent just before a stop, so the first also holds with the time that
it takes to see that, and the force that may then come.

A pull waits for a late input with the last setpoint standing. After ``patience`` what is held is let go, for which
joint states are needed; where they are missing, the release begins once they return within some seconds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from modcal_core.geometry import Array
from modcal_core.impedance.wrench import LowPass

_HARDLY = 0.05  # of the full speed: by then nearly the most force is on it
_PROMPT, _DOUBLES, _HEEDED = 0.03, 0.04, 0.5  # s: age that is usual, that doubles the damping, and for how long
_RATE_HZ = 20.0  # of the low-pass, what is above which counts as rising
_RIGID = 700e3  # N/m: steel fingers on a steel handle
# Of a force that a sensor hides: the lead of a servo that shows it [m], at most at this share of the last force; how
# long it must do so [s]; and times the last force that may have come by then
_LEAD, _UNFELT, _UNSEEN, _HIDDEN = 2e-4, 0.4, 0.05, 1.2
# N by which a force rises at a touch: more than noise; m in which it does so of fingers, however soft, and not of what
# opens; times stiffer than is stated may a touch seem, for delays
_TOUCH, _TOUCH_WAY, _STIFFER = 1.5, 0.8e-3, 1.5


@dataclass(frozen=True)
class GovernorSettings:
    """slowdown, stop: force [N] and moment [N m] at which the pace begins to fall, and at which it is zero.

    max_force: force that a hard stop may come to [N]. contact_stiffness: of hand and object [N/m].
    still_m: way [m] that counts as having moved. still_s: how long nothing may move under nearly the most force, or
    with the expected pose ``max_lead`` [m] ahead [s]. give_up_s: or under any force.
    """

    slowdown: tuple[float, float] = (30.0, 6.0)
    stop: tuple[float, float] = (47.5, 14.0)
    max_force: float = 50.0
    contact_stiffness: float = 20e3
    still_m: float = 0.002
    still_s: float = 1.0
    give_up_s: float = 8.0
    max_lead: float = 0.08

    def share(self, F: Array) -> float:
        """Share of the full speed, 0 … 1, at a force and moment F (6,)."""
        force, moment = math.sqrt(F[:3] @ F[:3]), math.sqrt(F[3:] @ F[3:])
        left = [
            (most - value) / (most - slow)
            for value, slow, most in zip((force, moment), self.slowdown, self.stop, strict=True)
        ]
        return min(max(min(left), 0.0), 1.0)


class ForcePrediction:
    """Force expected once all motion under way has ended."""

    def __init__(self) -> None:
        self._past = LowPass(_RATE_HZ)
        self.lag = self._past.lag  # s until it is seen that a force rises

    def ahead(self, F: Array, stamp: float, seconds: float) -> Array:
        """Force and moment (6,) some seconds after F (6,), felt at ``stamp`` [s], if it goes on rising as it does.

        It keeps its direction, and what falls is taken as it is: what is about to move need not be trusted to.
        """
        sizes = np.array([math.sqrt(F[:3] @ F[:3]), math.sqrt(F[3:] @ F[3:])])
        rising = np.maximum(sizes - self._past.take(sizes, stamp), 0.0) / self.lag
        return F * np.repeat(1.0 + seconds * rising / np.maximum(sizes, 1e-9), 3)


class SpeedGovernor:
    """The speed along the path [m/s], which gathers gently and brakes hard.

    caution: how many times slower it goes, and how many times more a hand is damped, as inputs come late. damping: with
    which what is as stiff as a hard stop is not hit again and again [N s/m].
    """

    def __init__(self, settings: GovernorSettings, gather: float = 0.15, brake: float = 2.0) -> None:
        """Standing. gather, brake: [m/s²]."""
        self.settings, self._gather, self._brake = settings, gather, brake
        self.speed, self.caution = 0.0, 1.0
        self._mark = (math.nan, 0.0)
        self._from, self._soft, self._stiff = (math.inf, np.zeros(3)), False, False
        self.damping = 0.0

    def heed(self, age: float, h: float) -> None:
        """Take h seconds in which inputs were so old [s]: what is stable at once need not be so a moment later."""
        now = 1.0 + max(age - _PROMPT, 0.0) / _DOUBLES
        self.caution = max(now, self.caution + (now - self.caution) * h / (h + _HEEDED))

    def step(self, wanted: float, most: float, F: Array, h: float) -> float:
        """Distance [m] to advance in h seconds at a wanted speed [m/s] under the force F (6,).

        most: the speed :meth:`in_sight` [m/s]. What is slowed down for the force that is felt need not be slowed down
        again for what a hard stop would add to it.
        """
        aim = min(wanted / self.caution * self.settings.share(F), most)
        self.speed = min(max(aim, self.speed - self._brake * h), self.speed + self._gather * h)
        return self.speed * h

    def touch(self, force: float, tool: Array) -> None:
        """Take a felt force [N] with where the tool (3,) was then [m]: how a force rises tells how stiff a touch is."""
        way, rise = math.dist(tool, self._from[1]), force - self._from[0]
        if rise >= _TOUCH and way <= _TOUCH_WAY:
            self._soft = True
            self._stiff = self._stiff or rise > _STIFFER * self.settings.contact_stiffness * way
        if not 0.0 <= rise < _TOUCH or way > _TOUCH_WAY:
            self._from = force, tool

    @property
    def contact(self) -> float:
        """Stiffness of hand and object [N/m]: what is stated where every touch agrees, else that of steel."""
        stated = self.settings.contact_stiffness
        return stated if self._soft and not self._stiff else max(stated, _RIGID)

    def in_sight(self, force: float, delay: float, stiffness: float, mass: float) -> float:
        """Largest speed [m/s] at which a hard stop now, at this force [N], keeps the peak below the limit.

        delay: how long it goes on as it does before it brakes [s]. stiffness: by which the servos hold the tool [N/m].
        mass: of the arm, at the tool [kg]. Solves F + v √(C m) + K (v T + v²/2a) = F_last.
        """
        contact, most = self.contact, self.settings.max_force
        hit, series = math.sqrt(contact * mass), contact * stiffness / (contact + stiffness)
        self.damping = series * delay
        speeds = []
        unseen = min(_LEAD * stiffness, _UNFELT * most)
        for last, late in ((most, delay), (_HIDDEN * most - unseen, delay + _UNSEEN)):
            slow = self._brake * (late + hit / series)
            speeds.append(math.sqrt(slow * slow + 2.0 * self._brake * max(last - force, 0.0) / series) - slow)
        return min(speeds)

    @property
    def braking(self) -> float:
        """For how long it would have to go on as it does, to go as far as it does until it stands [s]."""
        return 0.5 * self.speed / self._brake

    def stand(self, now: float) -> None:
        """Stand; patience starts from zero."""
        self.speed = 0.0
        self._mark = now, self._mark[1]

    def stuck(self, way: float, lead: float, F: Array, now: float) -> bool:
        """Whether nothing has moved for too long: way, measured along the path, and lead of the expected pose [m]."""
        since, mark = self._mark
        if not math.isfinite(since) or abs(way - mark) > self.settings.still_m:
            self._mark = now, way
            return False
        pushed = self.settings.share(F) < _HARDLY or lead > self.settings.max_lead
        return now - since > (self.settings.still_s if pushed else self.settings.give_up_s)


# s: a driver that is restarted publishes again within that; later somebody may have moved the arm, and must not be met
# by one that moves by itself
_RECOVERY_TIME = 5.0
NO_STATUS = "object_status: no recent message: check that articulation_estimator is alive and its input too"


class InputWatch:
    """Watch over a pull's inputs. timeout: oldest that is used [s]. pending: why to let go when joints return."""

    def __init__(self, timeout: float) -> None:
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
