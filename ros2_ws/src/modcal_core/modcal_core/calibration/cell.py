"""Where the arm's base and tool are, with the arm itself taken as it stands.

Covariances in messages are of all sorts: measured, copied from a data sheet, or invented. Where the arm stands still,
readings scatter by what the instrument adds from one to the next; a covariance that is far from that is not believed,
and one that nothing can be compared with is not used. What remains stands in for what a person would state.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from modcal_core.calibration.distances import AnyDistance, Distance, StationDistance
from modcal_core.calibration.fit import FITTED, Fit, Move, What, identify, identify_moved
from modcal_core.calibration.initial import locate, locate_base
from modcal_core.calibration.model import Model, place_model
from modcal_core.calibration.parameters import ModelParameter, with_prior
from modcal_core.calibration.placing import Known
from modcal_core.calibration.stated import MAX_DEG, MAX_MM, Stated, StatedTool, stated_std, stated_tool
from modcal_core.calibration.structure import choose_parameters, views_of
from modcal_core.effects import Effect, is_move
from modcal_core.errors import BadRecording, BadTable
from modcal_core.geometry import Array, so3
from modcal_core.measurements import (
    POINT,
    POSE,
    ReadingTrack,
    Recording,
    Samples,
    StationRules,
    dwells_of,
    inliers,
    joints_by_time,
)
from modcal_core.robots import Inertias, Mechanism, forward

WIDE = 50.0  # times the arm's prior: base and tool may be half a metre from where the closed form puts them


@dataclass(frozen=True)
class StatedPayload:
    """mass [kg] of what the tip carries, and its place in the tip link (3,) [m]."""

    mass: float
    place: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Cell:
    """What is known of the surroundings.

    distances: between the origins of frames, and between stations. fixed: parameters that must not change, by name,
    place or pattern. known: frames whose place relative to others, or to the base, is known. own_target: frames whose
    instrument watches a point of the tool of its own. sockets: frames in which the tool's ball rests at one point.
    stated: repeatability and accuracy that were stated. moved: when base or tool are known to have been moved.
    own_in_recordings: what each of several recordings has of its own. tool: where it is, where that is known. gravity:
    the way in which weight pulls in the base, (3,), of any length; None: as the robot description has it, or the data
    show. between: stamps [s] between recordings that were joined to one, in each of which something else was carried.
    payloads: what was carried beyond the robot description, in all or in each of the recordings, if that is known.
    """

    distances: tuple[AnyDistance, ...] = ()
    fixed: tuple[str, ...] = ()
    known: tuple[Known, ...] = ()
    own_target: tuple[str, ...] = ()
    stated: Stated = field(default_factory=Stated)
    sockets: tuple[str, ...] = ()
    moved: tuple[Move, ...] = ()
    own_in_recordings: What | None = None
    tool: StatedTool | None = None
    gravity: tuple[float, float, float] | None = None
    between: tuple[float, ...] = ()
    payloads: tuple[StatedPayload, ...] = ()

    @property
    def kept(self) -> tuple[str, ...]:
        """Patterns of parameters that must not change: those fixed, and frames that are known in the base."""
        return (*self.fixed, *(f"frame {k.frame}" for k in self.known if k.to == "base" and k.std is None))

    def with_move(self, move: Move) -> Cell:
        """The same with one more move that is known of."""
        return replace(self, moved=tuple(sorted((*self.moved, move), key=lambda m: m.at)))

    def states(self, effect: Effect, stamps: np.ndarray) -> bool:
        """Whether an effect is a move that was stated: of that place, no station (stamps [s]) between the two times."""
        if not is_move(effect):
            return False
        at = effect.shape.settings["at"]
        return any(
            move.what in ("both", effect.place)
            and not ((stamps > min(at, move.at)) & (stamps < max(at, move.at))).any()
            for move in self.moved
        )

    def met(self, samples: Samples) -> Cell:
        """The same with the stations found that distances are known between; raises BadTable where one is not there."""
        found = (d.met(samples) if isinstance(d, StationDistance) else d for d in self.distances)
        return replace(self, distances=tuple(found))

    def require_frames(self, frames: Sequence[str]) -> None:
        """Raises BadTable for something known of a frame that no reading came in."""
        of_frames = [n for k in self.known for n in (k.frame, k.to) if n != "base"]
        wanted = [("cell file", name) for name in (*of_frames, *self.own_target, *self.sockets)]
        for distance in self.distances:
            if isinstance(distance, Distance):
                wanted += [(f"known distance {' to '.join(distance.between)}", name) for name in distance.between]
        for offender, name in wanted:
            if name not in frames:
                remedy = f"name frames of the recording: {', '.join(frames)}"
                raise BadTable(offender, f"no reading has the frame '{name}'", remedy)


def fit_cell(
    chain: Mechanism, samples: Samples, cell: Cell, inertias: Inertias | None = None, start: Model | None = None
) -> Fit:
    """The fit of base frames and tool for this arm, from no guess at all.

    start: where base and tool, and what moved of them, are about; what moved is then fitted too.
    """
    if start is None:
        return refit_cell(place_model(chain, samples.frames, inertias), samples, cell)
    cell.require_frames(samples.frames)
    start = replace(start, arm=place_model(chain, samples.frames, inertias).arm)
    choice = choose_parameters(start, views_of(samples), cell.kept, cell.distances, among=lambda p: not p.of_arm)
    return identify_moved(start, samples, _wide(choice.parameters, cell), cell.distances, FITTED)


def refit_cell(model: Model, samples: Samples, cell: Cell, base: bool = True, tool: bool = True) -> Fit:
    """The fit of the base frames, the tool, or both; the rest of the model is kept.

    Bases that are fitted again need no guess, so the recording's frames may have other names than the model's.
    Raises BadTable where the bases are kept and the model does not know a frame.
    """
    cell.require_frames(samples.frames)
    if base and tool:
        start = locate(place_model(model.chain, samples.frames), samples, cell.known, cell.own_target)
        if cell.tool is not None:
            start = with_bases(replace(start, T_tip_tool=stated_tool(cell.tool, start.T_tip_tool)), samples, cell)
    elif base:
        unplaced = Model(
            model.chain, samples.frames, _identities(samples), model.T_tip_tool, instruments=model.instruments
        )
        start = locate_base(unplaced, samples, cell.known, cell.own_target)
    else:
        start = with_frames(model, samples.frames)
    start = replace(start, arm=model.arm)
    if start.arm is not None and start.arm.tool is None:
        start = replace(start, arm=replace(start.arm, tool=start.T_tip_tool[:3, 3]))
    choice = choose_parameters(
        start,
        views_of(samples),
        cell.kept,
        cell.distances,
        among=lambda p: not p.of_arm and ((base and p.place <= 0) or (tool and p.place > 0)),
    )
    start = start.with_effects(model.effects)
    return identify(start, samples, _wide(choice.parameters, cell), cell.distances, keep_effects=True)


def with_bases(model: Model, samples: Samples, cell: Cell) -> Model:
    """The model, its tool kept, with base frames and instruments where its arm then has them."""
    unplaced = replace(model, T_frame_base=_identities(samples), instruments=(), leaders=())
    return replace(locate_base(unplaced, samples, cell.known, cell.own_target), arm=model.arm)


def _wide(parameters: Sequence[ModelParameter], cell: Cell) -> list[ModelParameter]:
    """Parameters of base, tool and instruments with wide priors, but for what is stated."""
    return [
        wide if (stated := stated_std(p, cell.tool, cell.known)) is None else replace(p, prior_std=stated)
        for p, wide in zip(parameters, with_prior(parameters, WIDE), strict=True)
    ]


def free_cell(parameters: Sequence[ModelParameter], cell: Cell) -> tuple[ModelParameter, ...]:
    """The same parameters, those of base and tool with no prior but what is stated of them.

    Where the nominal arm puts base and tool says little of where they are, least of all where they hardly turn.
    """
    return tuple(
        replace(wide, seen_std=p.expected) if p.name.startswith(("frame ", "tool/")) else p
        for p, wide in zip(parameters, _wide(parameters, cell), strict=True)
    )


def with_frames(model: Model, frames: Sequence[str]) -> Model:
    """The model watched from these of its frames, in this order; raises BadTable for one it does not know."""
    for name in frames:
        if name not in model.frames:
            said = f"the calibration knows only {', '.join(model.frames)}"
            raise BadTable(f"frame '{name}' of the recording", said, "give --refit-base to find the base again")
    rows = [model.frames.index(name) for name in frames]
    return replace(
        model,
        frames=tuple(frames),
        T_frame_base=model.T_frame_base[rows],
        instruments=tuple(i for i in model.instruments if i.frame in frames),
        leaders=(),  # nothing moves any more
    )


def _identities(samples: Samples) -> np.ndarray:
    return np.tile(np.eye(4), (len(samples.frames), 1, 1))


# --- What an instrument says of its own error in its messages, checked against how its readings scatter

_FACTOR = 3.0  # of deviations; scatter has a slow part that standing still does not show, and filters hide some
_MIN = 50  # readings that a scatter is taken from, and twice as many as dwells
_REMEDY = "State --instrument-mm"


@dataclass(frozen=True)
class OwnStatement:
    """What is believed of instruments by their own word, and a sentence for each of them."""

    stated: Stated
    notes: tuple[str, ...] = ()


def own_statement(recording: Recording, names: tuple[str, ...], rules: StationRules | None = None) -> OwnStatement:
    """Errors that the instruments of a recording on one clock report of their readings, as far as the data bear it out.

    Of several instruments the largest error counts.
    """
    tracks = [track for track in recording.readings if track.stated is not None and len(track.stamps)]
    if not tracks:
        return OwnStatement(Stated())
    t, q = joints_by_time(recording, names)
    dwells = dwells_of(t, q, recording.readings, rules or StationRules())
    believed: list[tuple[float | None, float | None]] = []
    notes = []
    for track in tracks:
        assert track.stated is not None
        known = [c[np.isfinite(c)] for c in track.stated.T]  # of position [m] and angle [rad]
        own = np.array([float(np.median(c)) if len(c) else np.nan for c in known])
        seen = _scatter(track, dwells)
        name = f"{track.topic} ({track.frame})"
        units = ((1e3, "mm", MAX_MM), (np.degrees(1.0), "°", MAX_DEG))
        kept: list[float | None] = []
        for what, shown, (scale, unit, largest) in zip(own, seen, units, strict=True):
            borne_out = np.isfinite([what, shown]).all() and shown / _FACTOR <= what <= shown * _FACTOR
            value = float(scale * what) if borne_out and 0.0 < scale * what <= largest else None
            kept.append(value)
            if np.isfinite(what):
                notes.append(
                    f"{name} reports its own error as {scale * what:.3g} {unit}{_why(value, shown, scale, unit)}."
                )
        believed.append((kept[0], kept[1]))
    position, rotation = (
        None if any(pair[k] is None for pair in believed) else max(float(pair[k] or 0.0) for pair in believed)
        for k in (0, 1)
    )
    return OwnStatement(Stated(instrument_mm=position, instrument_deg=rotation), tuple(notes))


def together_stated(parts: Sequence[Stated]) -> Stated:
    """The largest statement of several pieces of a recording; none where one of them bears none out."""
    values = {}
    for name in ("instrument_mm", "instrument_deg"):
        each = [getattr(part, name) for part in parts]
        values[name] = None if not each or None in each else max(each)
    return Stated(**values)


def _why(value: float | None, shown: float, scale: float, unit: str) -> str:
    if not np.isfinite(shown):
        return f": not used, because the arm does not stand still long enough to compare. {_REMEDY}, if it is known"
    seen = f"its readings scatter by {scale * shown:.3g} {unit} where the arm stands still"
    return f"; {seen}, which agrees with it" if value is not None else f": not used, because {seen}"


def _scatter(track: ReadingTrack, dwells: Array) -> Array:
    """RMS over space by which readings scatter about the mean of their dwell, position [m] and angle [rad], (2,)."""
    order = np.argsort(track.stamps, kind="stable")
    stamps = track.stamps[order]
    square, freedom = np.zeros(2), 0
    for first, last in np.searchsorted(stamps, dwells).tolist() if len(dwells) else ():
        rows = order[first:last]
        if len(rows) < 3:
            continue
        values = track.values[rows]
        values = values[inliers(values[:, :3])]
        if len(values) < 3:
            continue
        square[0] += float(((values[:, :3] - values[:, :3].mean(axis=0)) ** 2).sum())
        if track.kind == POSE:
            R = so3.from_quaternion(values[:, 3:])
            turned = so3.log(np.swapaxes(so3.mean(R)[None], 1, 2) @ R)
            square[1] += float((turned**2).sum())
        freedom += len(values) - 1
    if freedom < _MIN:
        return np.full(2, np.nan)
    out = np.sqrt(square / freedom)
    return np.where([True, track.kind == POSE], out, np.nan)


# --- Frames that show one fixed point: stated ones are sockets, any other is a tracker that stands still

_MOVED = 0.02  # m; the tip's RMS distance from its mean beyond which a target that follows must be seen to move
_STANDS = 1e-3  # of that distance, and as many radians: what readings of a target that stands still vary by, noise only
_THOUSANDTH = (0.5e-3, 2e-3)  # of the tip's motion, as of readings in metres that were taken for millimetres
_FOLLOWS, _ENOUGH = 0.7, 12  # share of their size that follows the tip: of 12 readings of noise 0.44 (mean)


def with_sockets(samples: Samples, cell: Cell, chain: Mechanism) -> Samples:
    """The samples with the frames named that are sockets: listed as such, or with a known distance to another.

    Raises BadRecording for a tracker whose readings stand still while the arm moves.
    """
    of_distances = (name for d in cell.distances if isinstance(d, Distance) for name in d.between)
    stated = dict.fromkeys((*samples.sockets, *cell.sockets, *of_distances))
    sockets = tuple(f for i, f in enumerate(samples.frames) if f in stated and samples.stands_still(i))
    samples = replace(samples, sockets=sockets)
    for f, frame in enumerate(samples.frames):
        if frame not in sockets:
            _require_moving(samples.select(samples.frame == f), frame, chain)
    return samples


def _require_moving(samples: Samples, frame: str, chain: Mechanism) -> None:
    rows = np.isin(samples.kind, (POINT, POSE))
    if rows.sum() < 3:
        return
    samples = samples.select(rows)
    tip = forward(chain, samples.q)[:, :3, 3]
    moved = _scatter_of_sockets(tip)
    if moved < _MOVED:
        return
    turned = 0.0
    if samples.is_pose.all():
        mean = so3.mean(samples.R)
        turned = float(np.sqrt(np.mean(np.sum(so3.log(mean.T @ samples.R) ** 2, axis=1))))
    seen = _scatter_of_sockets(samples.reading)
    topic = f"/tracker/{samples.kind[0]} ({frame})"
    if _THOUSANDTH[0] * moved < seen < _THOUSANDTH[1] * moved and _follows(tip, samples.reading):
        said = f"readings follow the tip at a thousandth of its motion (RMS {1e3 * seen:.3g} of {1e3 * moved:.0f} mm)"
        raise BadRecording(topic, said, "positions look like metres taken for millimetres: state the unit m")
    if seen < _STANDS * moved and turned < _STANDS:
        raise BadRecording(
            topic,
            f"readings stand still (RMS {1e3 * seen:.3g} mm) while the joints move the tip by {1e3 * moved:.0f} mm",
            "check that the tracker follows its target and its driver sends new readings; "
            "a ball held in a socket is stated: list the frame under 'sockets' in the cell file (--cell)",
        )


def _follows(tip: np.ndarray, readings: np.ndarray) -> bool:
    """Whether readings (N, 3) follow the tip (N, 3), however little they move.

    What the best rotation or reflection makes alike is the sum of the singular values of their product.
    """
    a, b = tip - tip.mean(axis=0), readings - readings.mean(axis=0)
    alike = np.linalg.norm(a.T @ b, "nuc")
    return len(tip) >= _ENOUGH and bool(alike > _FOLLOWS * np.linalg.norm(a) * np.linalg.norm(b))


def _scatter_of_sockets(p: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum((p - p.mean(axis=0)) ** 2, axis=1))))
