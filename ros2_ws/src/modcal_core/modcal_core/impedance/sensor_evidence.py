"""What the force sensor has shown so far of whether it tells the force, and how fast one may go by that.

A sensor that says a fifth of every force is not told from a gentle object by what it says, but by the servos: it makes
them seem five times as soft as they are. So it is known to tell the force where two things were seen.

* It has told of a force, and the tool went on with that. At what does not move any sensor tells something in the end,
  and there is no place to speed up.
* As far as the servos' leads were learned from what it said, they yield no more than the joints of this arm may.

Until then the hand goes no faster than what is hidden at a hard stop is found out in time. Where the servos surely
yield more than they may, the sensor is wrong, or the arm is softer than stated, and the pull is over.
"""

from __future__ import annotations

import math

from modcal_core.errors import BadCommand

_CREEP, _FREE = 0.01, 8e-3  # m/s for the first m, which no hand goes without what it holds
_UNTOLD = 0.5  # of the usual speed beyond that, until the force sensor has felt anything
_TOLD = 2.0  # N that tell that it does: ten times the noise of a usual one
_GOES_ON = 3e-3  # m that the tool goes on with it: as much as fingers yield to 60 N, which a jam tells as well
_LIKELY, _SURE = 2.0, 3.0  # standard deviations of what servos yield, to believe a sensor and to refuse it
_BEYOND = 1.15  # times as soft as may be: drives' friction and a lag that is not one make as much of it


class SensorEvidence:
    """Call every tick. ``told``: whether the sensor has shown a force under which the tool moved on."""

    def __init__(self, known: bool) -> None:
        """Nothing was told yet. known: whether it is known by how much joints may yield."""
        self.told = False
        self._known = known
        self._since = math.inf  # m of progress at which a force was felt first
        self._softness: tuple[float, float] | None = None

    def take(self, force: float, progress: float, repeats: bool) -> None:
        """Note a felt force [N] with the tool so far [m] on its way. repeats: whether the sensor repeats itself."""
        if force < _TOLD or repeats:
            self._since = math.inf
            self.told = self.told and not repeats
            return
        self._since = min(self._since, progress)
        self.told = self.told or progress - self._since >= _GOES_ON

    def learned(self, softness: tuple[float, float] | None) -> None:
        """Note what the servos yield as a share of what they may at most, and its standard deviation; None: unknown."""
        self._softness = softness

    @property
    def corroborated(self) -> bool:
        """Whether the sensor has shown a force and agrees with the servos' leads where they can be judged."""
        if not self._known or self._softness is None:
            return self.told and not self._known
        share, unsure = self._softness
        return self.told and share + _LIKELY * unsure <= 1.0

    @property
    def said(self) -> str:
        """What the servos yield, as text; empty while that is not known."""
        if self._softness is None:
            return ""
        share, unsure = self._softness
        return f"{share:.2f} of max_joint_lead_rad, within {_LIKELY * unsure:.2f}"

    def refused(self) -> BadCommand | None:
        """Why to let go: by what the sensor says the servos surely yield more than they may; None where all is well."""
        if self._softness is None:
            return None
        share, unsure = self._softness
        if share - _SURE * unsure <= _BEYOND:
            return None
        said = f"by what it says, the joints yield {share:.1f} times as much as they may"
        return BadCommand("wrench", said, "check the force sensor and max_joint_lead_rad")

    def exploring(self, progress: float, usual: float, creep: float) -> float:
        """The speed [m/s] at which to go on into the unknown, with the tool so far [m] from where it began.

        A force sensor that has not told of anything may be stuck, and so may one that told of little: until the hand
        has come some way, and until the sensor has told, little may come of that. creep: speed at which what a
        misstated lag hides is little [m/s].
        """
        slow = min(_CREEP, creep)
        if progress < _FREE:
            return min(usual, slow)
        return usual if self.told else min(usual, max(slow, _UNTOLD * usual * slow / _CREEP))

    def following(self, usual: float, exploring: float, creep: float) -> float:
        """The speed [m/s] along a known path: as while exploring, until the sensor is corroborated."""
        return usual if self.corroborated else min(usual, exploring * min(1.0, creep / _CREEP))
