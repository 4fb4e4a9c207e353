"""Whether a joint predicts travel that it was not fitted to: the far third of its path, from either side.

A long hinge and a drawer that bows fit the same samples equally well. What the one says of the part that it has not
seen differs, and so does what a line and a circle through the first centimetres of a door say. And where a plainer
joint leaves no more than handles and cameras usually do, no curve is proved.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from modcal_core.articulation.fit import JointFit, fit
from modcal_core.articulation.furniture import PLAY
from modcal_core.articulation.misfit import MUCH, Misfit, misfit, usual
from modcal_core.articulation.models.model import ArticulationModel, Kind
from modcal_core.articulation.telling import travelled
from modcal_core.articulation.track import Track

_FITTED = 0.7  # of the path
_MIN_FITTED, _MIN_ASKED = 8, 3  # samples
MAY_MISS = 0.03  # of the path that was travelled
_MISSES = 4e-3  # m: twice the usual play, which no prediction does without
_NOISE = 3.0  # deviations of white noise beside it
_BETTER, _BY = 1.5, 1e-3  # times and m by which another joint type predicts plainly better
_COUNTED = 0.9  # of the samples, those that are predicted best


@dataclass(frozen=True)
class Predicted:
    """How far predictions of the far third are off [m], from the near and from the far end, by joint type.

    left: what the joint leaves of what it was fitted to [m]. path: that was travelled [m]. noise: white [m]. plainer:
    a joint type with fewer parameters that is as good as furniture is, empty where there is none. loose: whether it is
    a path in space that leaves more than furniture usually does: a thread has no such play, and most smooth paths are
    about a screw's.
    """

    kind: Kind
    errors: Mapping[Kind, tuple[float, ...]]
    left: float
    path: float
    noise: float
    plainer: Kind = ""
    loose: bool = False

    @property
    def doubt(self) -> str:
        """Why the joint type is not to be relied on, as text; empty where it predicts."""
        much = float(np.hypot(max(_MISSES, MAY_MISS * self.path), _NOISE * self.noise))
        if self.left > much:
            return f"it leaves {1e3 * self.left:.0f} mm of a path of {1e2 * self.path:.0f} cm"
        if self.loose:
            return f"it leaves {1e3 * self.left:.0f} mm, more than a {self.kind} usually does"
        own = self.errors.get(self.kind, ())
        if not own:
            return "samples are too few to fit a part of the path and predict the rest"
        if min(own) > much:
            return f"fitted to 70 % of the path it misses the rest by {1e3 * min(own):.0f} mm"
        for kind, other in self.errors.items():
            if kind != self.kind and all(a > max(_BETTER * b, b + _BY) for a, b in zip(own, other, strict=True)):
                return f"{kind} predicts better ({1e3 * max(other):.1f} against {1e3 * max(own):.1f} mm)"
        if self.plainer and min(self.errors[self.plainer], default=0.0) <= MUCH * np.exp(PLAY[0]):
            return f"{self.plainer} leaves no more than handles and cameras usually do"
        return ""


def predicted(
    track: Track,
    kind: Kind,
    rivals: list[Kind],
    fits: Mapping[Kind, JointFit],
    models: Mapping[Kind, ArticulationModel],
    left: Misfit,
) -> Predicted:
    """What this kind and its rivals, fitted to 70 % of the path from either end, say of the rest.

    left: what this kind leaves when it is fitted to all of it.
    """
    motion = fits[kind].motion
    a = motion.configurations(track, (1.0, 1e9))
    low, high = np.quantile(a, [0.01, 0.99])
    along = (a - low) / max(float(high - low), 1e-12)
    errors: dict[Kind, tuple[float, ...]] = {}
    for one in (kind, *rivals):
        off = []
        for near in (along < _FITTED, along > 1.0 - _FITTED):
            if near.sum() < _MIN_FITTED or (~near).sum() < _MIN_ASKED:
                continue
            seen = fit(track.part(near), models[one], start=fits[one].motion).motion
            R = None if track.rotations is None else track.rotations[~near]
            asked = Track.trusted(track.positions[~near], R)
            e = seen.residuals(asked, seen.configurations(asked, (1.0, 1e9)))
            sizes = np.sort(np.linalg.norm(e[:, :3], axis=1))[: int(np.ceil(_COUNTED * len(e)))]
            off.append(float(np.sqrt(np.mean(sizes**2))))
        errors[one] = tuple(off)
    fewer = [one for one in rivals if fits[one].motion.size < motion.size]
    plainer = next((one for one in fewer if _usual(misfit(fits[one], track, left.white))), "")
    loose = not (motion.flat or _usual(left))
    return Predicted(kind, errors, left.position, float(travelled(track)[-1]), left.white[0], plainer, loose)


def _usual(left: Misfit) -> bool:
    return usual(left.position, left.rotation, left.white)
