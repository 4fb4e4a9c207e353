"""Whether camera, target or arm were moved since the calibration, from the images that come in while the robot works.

The last few images are equations like those of a fit, about the calibrated model and with all that it knows as a prior.
*Nothing happened* stands against each half being elsewhere since one stop of the arm (six numbers) and each joint's
zero having slipped (one), as among the images of a fit (:mod:`changes`); the likeliest is named where it beats nothing
by far and the next one clearly. Images of several cameras are judged together: each camera may have been moved by
itself, while joints, and a target that cameras see from the same side, are one for all.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.camera.arm_poses import ArmPoses
from modcal_core.camera.bundle import BoardView, PrintedTarget
from modcal_core.camera.changes import GAIN, TIP, USUAL, WORLD, Change, of_twist, shift_of
from modcal_core.camera.corners import POSE, CameraState, CornerTable
from modcal_core.camera.equations import CameraRows, SolvedEquations
from modcal_core.camera.fit import CameraFit, camera_rows
from modcal_core.geometry import Array

_WINDOW = 8  # images that are looked back on
_CLEAR = 6.0  # of −2 log likelihood against the next likeliest: odds of 20 : 1
_SAME = 1e-3  # rad or m by which joints differ within a stop


@dataclass(frozen=True)
class Moved:
    """what: "camera", "target" or the name of a joint; "camera or arm", and so on, where images do not tell. since: the
    stamp, or number, of the first image after it. shift_m, turn_rad: by how much. gain: of −2 log likelihood.
    """

    what: str
    since: float
    shift_m: float
    turn_rad: float
    gain: float

    @property
    def sentence(self) -> str:
        """The finding as a sentence."""
        size = f"{np.degrees(self.turn_rad):.2f}°"
        if self.shift_m > 0.0:
            size = f"{1e3 * self.shift_m:.1f} mm and {size}"
        return f"The {self.what} was moved by {size}"


@dataclass(frozen=True)
class _Watched:
    """A camera. poses, state: of the fit. columns: of each of its parameters among those of all, −1 for none."""

    poses: ArmPoses
    state: CameraState
    columns: np.ndarray


@dataclass(frozen=True)
class _Seen:
    """An image. stamp: or its number. stop: number of the stop of the arm at which it was taken."""

    camera: str
    view: BoardView
    q: Array
    stamp: float
    stop: int


@dataclass(frozen=True)
class _Part:
    """What may have been moved. name: for a person. half: world or tip, empty of a joint. places: of the tool in the
    images that show it, (N, 3).
    """

    name: str
    half: str
    change: Change
    places: Array


class CameraWatch:
    """Watches the images of a calibrated cell; give it each as it comes."""

    def __init__(self, fit: CameraFit, target: PrintedTarget) -> None:
        """fit: the calibration, of one camera or several. target: as it was calibrated with, by all of them."""
        self._fit, self._target = fit, target
        self._cameras = {"": _Watched(fit.poses, fit.state, np.arange(len(fit.covariance)))}
        for one, columns, state in fit.poses.further_at(fit.state):
            self._cameras[one.name] = _Watched(one.poses, state, columns)
        known = fit.equations.solve(fit.sizes)
        information = np.zeros_like(fit.covariance)
        information[np.ix_(known.use, known.use)] = known.H
        nothing = np.zeros(len(information))
        self._known = replace(
            fit.equations, offset=nothing, information=information, beside=None, faults=None, places=None
        )
        self._seen: deque[_Seen] = deque(maxlen=_WINDOW * len(self._cameras))
        self._count = self._stop = 0

    def image(self, view: BoardView, q: Array, camera: str = "") -> Moved | None:
        """What was moved by this image, the arm standing at q (n,); None while nothing stands out.

        camera: of a further one its name. One that is not in the calibration says nothing.
        """
        self._count += 1
        if camera in self._cameras and len(view) >= POSE:
            if self._seen and np.abs(np.asarray(q) - self._seen[-1].q).max() > _SAME:
                self._stop += 1
            stamp = view.stamp if np.isfinite(view.stamp) else float(self._count)
            self._seen.append(_Seen(camera, view, np.asarray(q), stamp, self._stop))
        return self._judge()

    def forget(self) -> None:
        """Begin again, with the next image: after something was put right."""
        self._seen.clear()

    def _judge(self) -> Moved | None:
        stops = sorted({one.stop for one in self._seen})
        if len(stops) < 2:
            return None
        solved, parts = self._weighed(list(self._seen))
        places = np.arange(len(stops) - 1)  # a change that one stop alone shows may be a misread board
        found = sorted(((*part.change.best(solved, places), part) for part in parts), key=lambda f: -f[0])
        gain, first, x, part = found[0]
        if gain < GAIN or self._least_without(part.name, stops[first:]) < 0.5 * GAIN:
            return None
        names = [part.name, *(other.name for rival, *_, other in found[1:2] if gain - rival < _CLEAR)]
        shift = shift_of(part.half, x, part.places) if part.half else 0.0
        since = next(one.stamp for one in self._seen if one.stop == stops[first])
        turn = float(np.linalg.norm(x[3:] if part.half else x))
        return Moved(" or ".join(dict.fromkeys(names)), since, shift, turn, gain)

    def _least_without(self, name: str, after: Sequence[int]) -> float:
        """The least gain of a change before these stops that is left without any one of them: a single one may be
        misread, or its joints be of another moment, which is no move.
        """
        out = []
        for stop in after:
            seen = [one for one in self._seen if one.stop != stop]
            solved, parts = self._weighed(seen)
            part = next((one for one in parts if one.name == name), None)
            first = sum(s < after[0] for s in {one.stop for one in seen})
            out.append(part.change.best(solved, np.array([first]))[0] if part and len(after) > 1 else 0.0)
        return min(out)

    def _weighed(self, seen: Sequence[_Seen]) -> tuple[SolvedEquations, list[_Part]]:
        """(the equations of these images, what may have been moved among them)."""
        halves: dict[tuple[str, str], dict[int, Array]] = {}
        rows: list[CameraRows] = []
        joints, tools = [], []
        for camera in dict.fromkeys(one.camera for one in seen):
            own, watched = [one for one in seen if one.camera == camera], self._cameras[camera]
            at = watched.poses.at_postures(np.stack([one.q for one in own]))
            table = CornerTable.of([one.view for one in own], self._target)
            here = camera_rows(table, at, watched.state, watched.columns)
            T = at.tool_at(watched.state.values)
            for half, twists in zip((WORLD, TIP), at.half_motions(T), strict=True):
                carried = (half == TIP) == watched.poses.camera_on_tip  # it is the camera
                halves.setdefault((half, self._camera(camera) if carried else "target"), {})[len(rows)] = twists
            rows.append(replace(here, stop=np.array([one.stop for one in own])))
            joints.append(here.own)
            tools.append(T[:, :3, 3])
        solved = replace(self._known, cameras=tuple(rows)).solve(self._fit.sizes)
        order = np.arange(len({one.stop for one in seen}))
        parts = []
        for (half, name), twists_of in halves.items():
            change = Change({k: of_twist(rows[k], twists) for k, twists in twists_of.items()}, USUAL, order)
            parts.append(_Part(name, half, change, np.concatenate([tools[k] for k in twists_of])))
        for j, name in enumerate(self._fit.poses.model.chain.names):
            columns = {k: of_twist(rows[k], joint[:, :, j : j + 1]) for k, joint in enumerate(joints)}
            parts.append(_Part(f"joint {name}", "", Change(columns, USUAL[3:4], order), np.zeros((0, 3))))
        return solved, parts

    def _camera(self, name: str) -> str:
        """A camera by name, for a person."""
        return "camera" if len(self._cameras) == 1 else f"camera {name}" if name else "first camera"
