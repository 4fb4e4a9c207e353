"""How far the tool may be from where a calibration says: the claim, over the postures asked for.

Draws of the true arm (:mod:`evidence`) are compared with the calibrated one and with the nominal one, posture by
posture. Where no instrument knows the base, it is put where it suits best. What joints do not repeat comes on top, as
much as the scatter of the readings allows.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from modcal_core.calibration import (
    Calibration,
    Cell,
    Model,
    NoiseModel,
    RowView,
    Uncertainty,
    linearise,
    outside_drivers,
    procrustes,
)
from modcal_core.claim.beyond import growth
from modcal_core.claim.evidence import Drawn, draw
from modcal_core.claim.known import known, with_carried
from modcal_core.claim.neighbourhood import FREE, Neighbourhood, arms_near, joint_motion, shows_base
from modcal_core.claim.remedy import OpenDirection, open_direction
from modcal_core.effects import STEPS, NominalArm, of_readings
from modcal_core.geometry import Array, so3
from modcal_core.measurements import POSE, Samples
from modcal_core.measurements.kinds import KIND_NAMES
from modcal_core.robots import Mechanism, takes

StatisticName = Literal["mean", "rms", "p95", "max"]
NAMES: tuple[StatisticName, ...] = ("mean", "rms", "p95", "max")
_SEED = 47  # the same readings give the same word
_DRAWS, _POSTURES = 400, 200
_TIMES = 5  # of a recording, at one of which the next one may be as a whole
_TRIES = 50  # for each posture of a robot that cannot take all of them
_SURE = 0.95
_BEYOND = 1.05  # of the upper end: effects that no function of one joint stands for (bench/claims)
_MOSTLY = 0.5  # of the claim, from which what no reading shows is told
_UNKNOWN_M = 1e-3  # a ruler's; of a tool that readings of a known arm show no better, nothing is claimed along there


@dataclass(frozen=True)
class Statistic:
    """value: the most likely one. ci95: its ends, each passed with a chance of 5 %. In mm or deg."""

    value: float
    ci95: tuple[float, float]


@dataclass(frozen=True)
class Claim:
    """mm, deg: by the statistic's name; deg None if no reading shows an orientation. over: which postures.

    shown_mm, unshown_mm: upper ends of the 95th percentile with what the readings show alone, and with what only the
    usual size of errors holds. open: what those directions are, and what shows them. nominal_p95: of the nominal arm
    [mm]. apply: whether the calibrated arm is surely the better one. ranges: of the joints by name, in which it is, and
    not over the whole of them; None: anywhere. known: covariance of the calibrated model where
    the readings do not show every direction of the tool, else None: it is that of the fit.
    """

    mm: Mapping[StatisticName, Statistic]
    deg: Mapping[StatisticName, Statistic] | None
    over: str
    shown_mm: float
    unshown_mm: float
    nominal_p95: float
    apply: bool
    ranges: Mapping[str, tuple[float, float]] | None
    open: OpenDirection
    known: Uncertainty | None = field(repr=False, compare=False)

    @property
    def is_open(self) -> bool:
        """Whether most of the 95th percentile is held by what arms are like, and by no reading."""
        return self.unshown_mm > _MOSTLY * self.mm["p95"].ci95[1]

    @property
    def remedy(self) -> str:
        """What would make the claim narrower, as a sentence."""
        return self.open.remedy if self.is_open else OpenDirection().remedy

    @property
    def sentence(self) -> str:
        """What a person should know of the tool."""
        p95 = self.mm["p95"]
        said = f"At the tool, over the {self.over}: 95 % of the errors are below {p95.ci95[1]:.3f} mm"
        if self.is_open:
            said += (
                f" ({self.shown_mm:.3f} mm shown by the readings; {self.unshown_mm:.3f} mm held by what arms are like: "
                f"{self.open.what})"
            )
        said += f"; the nominal arm's below {self.nominal_p95:.3f} mm."
        if self.is_open:
            said += f" {self.open.remedy}"
        if not self.apply:
            said += " It is not sure that the calibrated arm is the better one: do not apply it."
        elif self.ranges is not None:
            said += " Apply it within the recorded joint ranges only: beyond them the nominal arm may be better."
        return said


def claim_at_tool(
    calibration: Calibration,
    samples: Samples,
    cell: Cell,
    postures: Array | None = None,
    frozen: Literal["", "arm", "whole"] = "",
    carried: Model | None = None,
) -> Claim:
    """The claim of a calibration by these samples, none of them wrong.

    postures: joint positions asked for (M, n) [rad, m]; None: random ones in the recorded ranges. frozen: what was made
    from other samples, which counts beside these: the whole, or the arm alone, base and tool being of these. Where they
    surely moved, these alone tell how far. carried: the model as another recording gets it, where that is less.
    """
    whole = calibration.calibrated
    about = arms_near(whole, calibration.nominal.chain, samples, cell)
    about = with_carried(about, calibration, placed=frozen == "whole") if frozen else about
    claim, drawn = _claim(about, replace(calibration, calibrated=carried or whole), samples, postures)
    return claim if frozen or shows_base(samples, _frame(samples)) else replace(claim, known=known(about, drawn))


def expected_claim(
    calibration: Calibration, planned: Samples, cell: Cell, noise: NoiseModel, postures: Array | None = None
) -> Claim:
    """The claim that readings at planned stations would give, by an instrument of this noise.

    planned: stations with readings of any value. postures: asked for, (M, n) [rad, m]; None: in the planned ranges.
    """
    about = arms_near(calibration.calibrated, calibration.nominal.chain, planned, cell, noise=noise)
    return _claim(about.unread(), calibration, planned, postures)[0]


@dataclass(frozen=True)
class _Errors:
    """Errors of the calibrated arm at M postures, by draws (D, 3 M) [m]. turned: of its orientations [rad]. open: what
    no reading holds of the positions. other: what the nominal arm is off besides, alike. samples: these postures.
    """

    calibrated: Array
    turned: Array
    open: Array
    other: Array
    samples: Samples

    def norms(self, errors: Array) -> Array:
        """Lengths (D, M) of errors (D, 3 M)."""
        return np.sqrt((errors.reshape(len(errors), 3, len(self.samples)) ** 2).sum(axis=1))

    @property
    def better(self) -> bool:
        """Whether the calibrated arm is surely the better one."""
        ours, other = (_of(self.norms(e), "rms") for e in (self.calibrated, self.calibrated + self.other))
        return bool(np.mean(ours < other) >= _SURE)


def _claim(
    about: Neighbourhood, calibration: Calibration, samples: Samples, postures: Array | None
) -> tuple[Claim, Drawn]:
    rng = np.random.default_rng(_SEED)
    drawn = draw(about, _DRAWS, rng)
    low, high = samples.q.min(axis=0), samples.q.max(axis=0)
    q = _random(about.model.chain, low, high, rng) if postures is None else postures
    there = _at(about, samples, q if len(q) else samples.q, rng)
    at = _errors(about, calibration, drawn, there)
    M = len(at.samples)
    joints = _joints(about, at.samples, drawn, rng)
    if about.g.any():  # there are readings
        joints = joints * np.tile(growth(about, drawn.values, samples, at.samples.q, rng), 6)
    at = replace(at, calibrated=at.calibrated + joints[:, : 3 * M], turned=at.turned + joints[:, 3 * M :])
    shown, deg = at.norms(at.calibrated - at.open), None
    if samples.is_pose.any():
        angles = at.norms(at.turned)
        deg = {name: _statistic(np.degrees(angles), name) for name in NAMES}
    whole = _random(about.model.chain, *_limits(about.model.chain, low, high), rng)
    anywhere = len(whole) and _errors(about, calibration, drawn, _at(about, samples, whole, rng)).better
    ranges = {name: (float(a), float(b)) for name, a, b in zip(samples.names, low, high, strict=True)}
    claim = Claim(
        mm={name: _statistic(1e3 * at.norms(at.calibrated), name) for name in NAMES},
        deg=deg,
        over="recorded ranges" if postures is None else "postures asked for",
        shown_mm=_statistic(1e3 * shown, "p95").ci95[1],
        unshown_mm=_statistic(1e3 * at.norms(at.open), "p95").ci95[1],
        nominal_p95=float(np.median(_of(1e3 * at.norms(at.calibrated + at.other), "p95"))),
        apply=at.better,
        ranges=None if anywhere or not at.better else ranges,
        open=open_direction(at.open, _view(about, at.samples).f.p[-1], there[1]),
        known=None,
    )
    return claim, drawn


def _errors(about: Neighbourhood, calibration: Calibration, drawn: Drawn, asked: tuple[Samples, bool]) -> _Errors:
    samples, placed = asked
    J = _without_scale(about, linearise(about.model, about.parameters, about.values, samples).J)
    position, rotation = np.split(J, 2, axis=1)
    apart, _ = _apart(about.model, calibration.nominal.with_effects(()), samples, placed)
    applied = _applied(calibration)
    met = [_apart(about.model, applied, met, placed) for met in _courses(about, samples)]
    lost, turned = (np.array(each)[np.arange(len(drawn.values)) % len(met)] for each in zip(*met, strict=True))
    P = _unknown(about, drawn, position, samples, placed)
    move, apart, lost = (rows - (rows @ P) @ P.T for rows in (position, apart[None], lost))
    calibrated, turned = drawn.values @ move + lost, drawn.values @ rotation + turned
    return _Errors(calibrated, turned, drawn.open @ move, apart - lost, samples)


def _courses(about: Neighbourhood, asked: Samples) -> list[Samples]:
    """The postures asked for as other recordings may have them: where something goes by time, all of them at one."""
    if not any("time" in outside_drivers(e) and e.shape.kind not in STEPS for e in about.model.effects):
        return [asked]
    rows = np.argsort(asked.stamps)[np.linspace(0.0, len(asked) - 1.0, _TIMES).astype(int)]
    where = {name: getattr(asked, name) for name in ("q", "frame", "kind", "reading", "R")}
    return [replace(asked.select(np.full(len(asked), row)), **where) for row in rows]


def _applied(calibration: Calibration) -> Model:
    """The model as it predicts, outside of the joint ranges that were seen as well."""
    model = calibration.calibrated
    arm = replace(model.arm or NominalArm(calibration.nominal.chain), limits=calibration.driver_limits)
    return replace(model, arm=arm, fallback=model.fallback or calibration.fallback(model, calibration.geometric))


def _limits(chain: Mechanism, low: Array, high: Array) -> tuple[Array, Array]:
    """Ends of the joints' whole ranges (n,), half a turn either way or what was recorded where there are none."""
    turn = np.where(chain.revolute, np.pi, 0.0)
    return (
        np.where(np.isfinite(chain.lower), chain.lower, np.minimum(low, -turn)),
        np.where(np.isfinite(chain.upper), chain.upper, np.maximum(high, turn)),
    )


def _random(chain: Mechanism, low: Array, high: Array, rng: np.random.Generator) -> Array:
    """Random postures between these ends that the robot can take, (M, n)."""
    q = rng.uniform(low, high, (_TRIES * _POSTURES if chain.closed else _POSTURES, len(low)))
    return q[takes(chain, q)][:_POSTURES] if chain.closed else q


def _frame(samples: Samples) -> int:
    """The first frame that knows the base, or the first."""
    return next((f for f in range(len(samples.frames)) if shows_base(samples, f)), 0)


def _at(about: Neighbourhood, samples: Samples, q: Array, rng: np.random.Generator) -> tuple[Samples, bool]:
    """Postures q (M, n) as samples of poses, beside each what came with a recorded sample after the last step; and
    whether readings show where the base is.
    """
    moved = [e.shape.settings["at"] for e in about.model.effects if e.shape.kind in STEPS]
    now = np.flatnonzero(samples.stamps >= min(max(moved, default=-np.inf), samples.stamps.max()))
    beside, frame = samples.select(rng.choice(now, len(q))), _frame(samples)
    asked = replace(
        beside,
        q=q,
        frame=np.full(len(q), frame),
        kind=np.full(len(q), POSE, dtype=KIND_NAMES),
        reading=np.zeros((len(q), 3)),
        R=np.tile(np.eye(3), (len(q), 1, 1)),
    )
    return asked, shows_base(samples, frame)


def _without_scale(about: Neighbourhood, J: Array) -> Array:
    """The derivatives without those of a reading's scale, which moves no tool."""
    out, j = J, len(about.parameters)
    for effect in about.model.effects:
        if of_readings(effect.place):
            out = out.copy() if out is J else out
            out[j : j + len(effect.values)] = 0.0
        j += len(effect.values)
    return out


def _apart(model: Model, other: Model, asked: Samples, placed: bool) -> tuple[Array, Array]:
    """From another model's tool to the calibrated one's, as seen from the latter's root, (3 M,) [m] and [rad].

    placed: whether the readings show where the base is; else it is put where it suits best.
    """
    T, drawn = model.predict_samples(asked), other.predict_samples(asked)
    if not placed:
        drawn = procrustes(drawn[:, :3, 3], T[:, :3, 3]) @ drawn
    R = (model.T_frame_base[asked.frame[0]] @ model.chain.T_base_root)[:3, :3]
    turned = so3.log(T[:, :3, :3] @ np.swapaxes(drawn[:, :3, :3], -1, -2))
    return ((T - drawn)[:, :3, 3] @ R).T.ravel(), (turned @ R).T.ravel()


def _unknown(about: Neighbourhood, drawn: Drawn, J: Array, asked: Samples, placed: bool) -> Array:
    """An orthonormal basis (3 M, b) of what moves the tool and no reading shows: the base, where no instrument knows
    it, and directions of the tool. J: (K, 3 M).
    """
    out = []
    if not placed:
        p = _view(about, asked).f.p[-1]
        p = p - p.mean(axis=1, keepdims=True)
        for axis in np.eye(3):
            out += [np.repeat(axis, len(asked)), so3.cross(np.repeat(axis[:, None], len(asked), axis=1), p).ravel()]
    tool = [j for j, parameter in enumerate(about.parameters) if parameter.name in ("tool/x", "tool/y", "tool/z")]
    if tool:
        free = np.flatnonzero(about.sort == FREE)
        std = drawn.std[free]
        C = np.linalg.inv(about.equations(drawn.noise)[0][np.ix_(free, free)] * np.outer(std, std) + np.eye(len(free)))
        own = np.isin(free, tool)
        size, directions = np.linalg.eigh((C * np.outer(std, std))[np.ix_(own, own)])
        out += list(directions[:, size > _UNKNOWN_M**2].T @ J[tool])
    return np.linalg.qr(np.array(out).T)[0] if out else np.zeros((3 * len(asked), 0))


def _joints(about: Neighbourhood, asked: Samples, drawn: Drawn, rng: np.random.Generator) -> Array:
    """What joints do not repeat, at each posture what they missed at some station, (D, 6 M) [m, then rad]."""
    view, (rounds, stations, n) = _view(about, asked), about.missed.shape
    motions = np.stack([joint_motion(view, about.model.chain, j) for j in range(n)])
    D, M = len(drawn.values), len(asked)
    one, known = rng.integers(rounds, size=(D, 1)), rng.integers(stations, size=(D, stations))
    station = np.take_along_axis(known, rng.integers(stations, size=(D, M)), axis=1)  # others may have been recorded
    missed = np.moveaxis(drawn.scale[:, None, None] * about.missed[one, station], 2, 0)
    return np.asarray(sum(np.tile(m, 6) * motion for m, motion in zip(missed, motions, strict=True)))


def _view(about: Neighbourhood, asked: Samples) -> RowView:
    return RowView.of(about.model, asked, about.model.drivers(asked))


def _of(norms: Array, name: StatisticName) -> Array:
    if name == "mean":
        return np.asarray(norms.mean(axis=1))
    if name == "rms":
        return np.asarray(np.sqrt((norms**2).mean(axis=1)))
    return np.asarray(np.percentile(norms, 95, axis=1) if name == "p95" else norms.max(axis=1))


def _statistic(norms: Array, name: StatisticName) -> Statistic:
    every = _of(norms, name)
    low, middle, high = np.quantile(every, [1.0 - _SURE, 0.5, _SURE])
    return Statistic(float(middle), (float(low), _BEYOND * float(high)))
