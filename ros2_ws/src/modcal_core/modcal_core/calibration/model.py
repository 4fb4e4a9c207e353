"""The model that is fitted: a chain, the frames and instruments it is watched from, the tool, and its effects.

The geometry beside curves is not the best without them. Whether the geometry that is best alone does better where no
curve was seen is read from the calibration's own recording, the outermost postures of which are left out of a fit of
either (:mod:`modcal_core.calibration.final_fit`); and wherever outside the full model hardly knows itself, geometry
alone speaks too (:mod:`modcal_core.calibration.covariance`). It comes in over a twentieth of a radian, so that no
command jumps. It speaks as well where a signal that an effect goes by leaves what was recorded of it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modcal_core.effects import Drivers, Effect, NominalArm, claimed, motion
from modcal_core.errors import BadRobot
from modcal_core.geometry import Array, se3
from modcal_core.measurements import Samples
from modcal_core.measurements.kinds import Constant, Kind, Scene, Sight, kinds
from modcal_core.robots import Chain, Frames, Inertias, Mechanism, forward, is_serial_arm, tool_frames

# --- The instruments of a cell whose readings are no positions, and what they say of a model at given samples

_TARGET = tuple(Constant(f"target_{axis}", "m", 0.05) for axis in "xyz")


@dataclass(frozen=True)
class Instrument:
    """One kind of reading in one frame. values: constants of the kind, (V,). target: where the point that it watches
    sits in the tool's frame [m], (3,); None where it is the tool's origin, as for all others.
    """

    frame: str
    kind: str
    values: Array
    target: Array | None = None

    @property
    def of_kind(self) -> Kind:
        """The kind itself."""
        return kinds()[self.kind]

    @property
    def constants(self) -> tuple[Constant, ...]:
        """What is fitted: the kind's constants, then the target, where it is its own."""
        return (*self.of_kind.constants, *(() if self.target is None else _TARGET))

    def moved(self, change: Array) -> Instrument:
        """The instrument with its constants changed by parameters (k,)."""
        own = len(self.of_kind.constants)
        target = None if self.target is None else self.target + change[own:]
        return replace(self, values=self.of_kind.moved(self.values, change[:own]), target=target)

    def moved_by(self, change: Array) -> Array:
        """d(values, target)/d(parameters), at this change."""
        own = len(self.of_kind.constants)
        J = self.of_kind.moved_by(self.values, change[:own])
        if self.target is None:
            return J
        out = np.zeros((J.shape[0] + 3, J.shape[1] + 3))
        out[: J.shape[0], : J.shape[1]] = J
        out[J.shape[0] :, J.shape[1] :] = np.eye(3)
        return out

    def rows(self, samples: Samples) -> np.ndarray:
        """Indices of its samples."""
        if self.frame not in samples.frames:
            return np.empty(0, int)
        return np.flatnonzero((samples.frame == samples.frames.index(self.frame)) & (samples.kind == self.kind))

    def at_target(self, T_base_tool: Array) -> Array:
        """Poses (m, 4, 4) of the tool shifted to what is watched."""
        return T_base_tool if self.target is None else T_base_tool @ se3.transform(p=self.target)

    def scene(self, T_root_frame: Array, f: Frames, rows: np.ndarray) -> Scene:
        """Scene of the target at these rows. f: frames of the chain from the root, the tool last."""
        axes, tool = f.axes[-1][:, :, rows], f.p[-1][:, rows]
        target = tool if self.target is None else tool + np.einsum("dim,d->im", axes, self.target)
        return Scene(T_root_frame, target, tool, axes)

    def see(self, scene: Scene, reading: Array) -> Sight:
        """What its readings (m, 3) say, the target's derivatives behind those of its constants."""
        sight = self.of_kind.see(scene, self.values, reading)
        if self.target is None:
            return sight
        by_target = np.einsum("ijm,djm->dim", sight.through, scene.axes)
        return replace(sight, constants=np.concatenate([sight.constants, by_target]))


def new_instruments(
    samples: Samples, own_target: Sequence[str] = (), before: Sequence[Instrument] = ()
) -> tuple[Instrument, ...]:
    """An instrument, its constants unknown yet, for every kind in every frame that gives no positions.

    own_target: frames whose instrument watches a point of the tool of its own. before: instruments whose targets are
    where they were.
    """
    targets = {name: np.zeros(3) for name in own_target}
    targets |= {i.frame: i.target for i in before if i.target is not None}
    pairs = sorted({(int(f), str(k)) for f, k in zip(samples.frame, samples.kind, strict=True)})
    return tuple(
        Instrument(samples.frames[f], k, kinds()[k].start(), targets.get(samples.frames[f]))
        for f, k in pairs
        if not kinds()[k].direct
    )


@dataclass
class Sights:
    """What the readings of all instruments say, among N samples.

    watched: the point of each sample that counts, (3, N). rows: of the instruments' samples, (m,). residual, scale: in
    the kind's unit; scale is the change of the prediction per unit of an error of scale, (3, m). through: (3, 3, m).
    lever: metres at the tool per unit of residual, (N,), one for positions. constants: for each instrument that read
    something its rows and the change of the prediction per constant, (V, 3, m).
    """

    watched: Array
    rows: np.ndarray
    residual: Array
    scale: Array
    through: Array
    lever: Array
    constants: dict[int, tuple[np.ndarray, Array]]

    def look_through(self, motion: Array) -> None:
        """Replace motions (3, N) of the watched points by what the instruments see of them."""
        motion[:, self.rows] = np.einsum("ijm,jm->im", self.through, motion[:, self.rows])


def look(
    instruments: Sequence[Instrument], samples: Samples, reading: Array, T_root_frame: Array, f: Frames
) -> Sights | None:
    """What the instruments say of a chain; None where none of them read anything.

    reading: the samples' readings, free of an error of scale, (N, 3). T_root_frame: (F, 4, 4). f: frames of the chain
    from the root, the tool last.
    """
    seen: dict[int, tuple[np.ndarray, Sight]] = {}
    for i, instrument in enumerate(instruments):
        if len(rows := instrument.rows(samples)):
            scene = instrument.scene(T_root_frame[samples.frames.index(instrument.frame)], f, rows)
            seen[i] = rows, instrument.see(scene, reading[rows])
    if not seen:
        return None
    watched, lever = f.p[-1].copy(), np.ones(len(samples))
    for rows, sight in seen.values():
        watched[:, rows], lever[rows] = sight.watched, sight.lever
    parts = seen.values()
    return Sights(
        watched,
        np.concatenate([rows for rows, _ in parts]),
        np.concatenate([sight.residual for _, sight in parts], axis=1),
        np.concatenate([sight.scale for _, sight in parts], axis=1),
        np.concatenate([np.broadcast_to(sight.through, (3, 3, len(rows))) for rows, sight in parts], axis=2),
        lever,
        {i: (rows, sight.constants) for i, (rows, sight) in seen.items()},
    )


# --- Outside the ranges of joints and signals that were seen another model speaks

BLEND = 0.05  # rad or m beyond what was seen, over which the other model comes in
_BLEND_SIGNAL = 0.1  # the same of a signal, in its range: no unit says what is near


class Doubting(Protocol):
    """Says how much a model should be doubted."""

    def share(self, samples: Samples, drivers: Drivers | None = None) -> Array:
        """How much geometry alone should count instead at these samples, in [0, 1], (N,).

        drivers: of the samples, where they are known already.
        """
        ...


@dataclass(frozen=True)
class Fallback:
    """The model outside, with the same frames, and where that is.

    low, high: ends of the joint ranges that were seen, (n,). curved: joints that curves depend on, (n,). doubt: how
    much the full model should be doubted there; None: altogether. signals: ends of those signals, by name and lag, that
    effects go by: beyond them nothing is known of an effect.
    """

    model: Model
    low: Array
    high: Array
    curved: np.ndarray
    doubt: Doubting | None = None
    signals: Mapping[tuple[str, float], tuple[float, float]] = field(default_factory=dict)

    def share(self, samples: Samples, drivers: Drivers | None = None) -> Array:
        """How much of it counts at samples, in [0, 1], (N,): none inside, from BLEND beyond as much as is doubted.

        drivers: of the samples, where they are known already.
        """
        beyond = np.maximum(np.maximum(self.low - samples.q, samples.q - self.high), 0.0)[:, self.curved]
        out = _smooth(beyond.max(axis=1, initial=0.0) / BLEND)
        rows = np.flatnonzero(out > 0.0)
        if self.doubt is not None and len(rows):
            everywhere = len(rows) == len(out)
            some = (samples, drivers) if everywhere else (samples.select(rows), None)
            out[rows] *= self.doubt.share(*some)
        for (name, lag), (low, high) in self.signals.items():
            x = self.model.drivers(samples).values(name, lag)  # of an arm without limits
            away = np.maximum(np.maximum(low - x, x - high), 0.0)
            out = np.maximum(out, _smooth(away / max(_BLEND_SIGNAL * (high - low), 1e-12)))
        return out

    def blended(self, T: Array, samples: Samples) -> Array:
        """Poses (N, 4, 4) of the full model, replaced by this one in proportion to how far outside the samples are."""
        share = self.share(samples)
        rows = np.flatnonzero(share > 0.0)
        if not len(rows):
            return T
        return between(T, rows, share[rows], self.model.predict_samples(samples.select(rows)))


def _smooth(u: Array) -> Array:
    """From 0 to 1 as u goes there, without a kink."""
    u = np.clip(u, 0.0, 1.0)
    return np.asarray(u * u * (3.0 - 2.0 * u))


def between(T: Array, rows: np.ndarray, share: Array, other: Array) -> Array:
    """Poses T (N, 4, 4), those of these rows moved by a share (m,) towards others (m, 4, 4)."""
    out = np.array(T)
    out[rows] = T[rows] @ se3.exp(share[:, None] * se3.log(se3.inverse(T[rows]) @ other))
    return out


def curved_joints(effects: tuple[Effect, ...], names: tuple[str, ...]) -> np.ndarray:
    """Which joints curves depend on, (n,); not the small ones that no report names, which end by themselves."""
    named = [e for e in effects if claimed(e)]
    of = {part.partition(":")[2] for e in named for part in e.driver.split(",") if part.startswith("position:")}
    return np.array([name in of for name in names])


IntArray = NDArray[np.int_]


@dataclass(frozen=True)
class Model:
    """Predicts ``T_frame_tool = T_frame_base · FK(q) · T_tip_tool``, with the effects' small motions put in.

    chain: the robot, serial or a Delta. frames: names of the frames readings come in. T_frame_base: pose of the robot's
    base in each, (F, 4, 4) [m]. T_tip_tool: pose of what the instruments see, in the tip, (4, 4) [m]. effects: what
    geometry cannot say. arm: the nominal arm that loads are computed from; None where there are no effects.
    instruments: those whose readings are no positions. leaders: for each frame the one whose errors it shares, by
    index, where some are known relative to others; empty where each stands for itself. fallback: what counts outside
    the ranges that a frozen model has seen; None while it is fitted.
    """

    chain: Mechanism
    frames: tuple[str, ...]
    T_frame_base: Array
    T_tip_tool: Array
    effects: tuple[Effect, ...] = ()
    arm: NominalArm | None = None
    instruments: tuple[Instrument, ...] = ()
    leaders: tuple[int, ...] = ()
    fallback: Fallback | None = None

    def leader(self, frame: int) -> int:
        """The frame whose errors this one shares."""
        return self.leaders[frame] if self.leaders else frame

    def frames_led_by(self, frame: int) -> tuple[int, ...]:
        """The frames that share this one's errors, itself among them."""
        return tuple(f for f in range(len(self.frames)) if self.leader(f) == frame)

    def predict(self, q: ArrayLike, frame: IntArray | int = 0) -> Array:
        """Poses of the tool by geometry alone, (N, 4, 4), in the frames with these indices, for postures q (N, n)."""
        return self.T_frame_base[frame] @ forward(self.chain, q) @ self.T_tip_tool

    def predict_samples(self, samples: Samples) -> Array:
        """Poses of the tool, (N, 4, 4), as the readings of these samples should show them, effects included."""
        if not self.effects:
            return self.predict(samples.q, samples.frame)
        twists, scale = motion(self.effects, self.drivers(samples))
        T_root_tool = tool_frames(self.chain, self.T_tip_tool, samples.q, twists).transform(-1)
        T = (self.T_frame_base @ self.chain.T_base_root)[samples.frame] @ T_root_tool
        T[:, :3, 3] *= scale[:, None]
        return T if self.fallback is None else self.fallback.blended(T, samples)

    def drivers(self, samples: Samples) -> Drivers:
        """The drivers at these samples."""
        return Drivers(samples, self.arm or NominalArm(self.chain))

    @property
    def serial(self) -> Chain:
        """The arm where it is a serial chain; raises BadRobot for what works on such only."""
        if is_serial_arm(self.chain):
            return self.chain
        names = ", ".join(self.chain.names)
        raise BadRobot(f"robot with joints {names}", "is a Delta", "give a serial arm: this works on no other")

    def with_chain(self, chain: Mechanism) -> Model:
        """The same cell with another arm model."""
        return replace(self, chain=chain)

    def with_effects(self, effects: tuple[Effect, ...]) -> Model:
        """The same geometry with other effects."""
        return replace(self, effects=effects)


def place_model(chain: Mechanism, frames: tuple[str, ...], inertias: Inertias | None = None) -> Model:
    """A model with base and tool where nothing is known of them yet: at the frames' and the tip's origins."""
    eye = np.eye(4)
    return Model(chain, frames, np.tile(eye, (len(frames), 1, 1)), eye, arm=NominalArm(chain, inertias))
