"""The minimal parameters for a robot and the kinds of reading it is watched by."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.calibration.distances import AnyDistance, distance_rows
from modcal_core.calibration.linearisation import linearise
from modcal_core.calibration.model import Instrument, Model, new_instruments
from modcal_core.calibration.parameters import ModelParameter, View, drop_fixed, independent_columns, ordered_candidates
from modcal_core.geometry import Array, se3, so3
from modcal_core.measurements import POSE, Samples
from modcal_core.measurements.kinds import KIND_NAMES, PLANE, kinds, scene_in
from modcal_core.robots import Chain, Mechanism, forward, is_serial_arm, random_postures, spatial_jacobian

_SEED = 20  # postures must be general, not new: the same robot always gets the same parameters
_EXACTLY = 1e-7  # what is left of a column that says nothing new, rounding alone
_NEARLY = 5e-3  # the same for planes: one that stands across an axis but for the error of its placing is taken to do so
_SPARE = 6  # postures drawn for each that is kept, where an instrument cannot read at all of them
_GENERAL_FRAME = se3.transform(so3.exp([0.4, 0.7, -0.3]), [1.3, -0.8, 0.6])  # at no plane or axis of an arm
_GENERAL_TOOL = se3.transform(so3.exp([0.3, -0.2, 0.5]), [0.11, 0.07, 0.13])  # on no joint's axis


def views_of(samples: Samples) -> tuple[View, ...]:
    """The distinct (kind, frame) pairs of the samples, and which of them only ever show one fixed point."""
    pairs = sorted({(int(f), str(k)) for f, k in zip(samples.frame, samples.kind, strict=True)})
    return tuple(View(kind, frame, samples.is_same_point(frame)) for frame, kind in pairs)


def postures_at_point(chain: Chain, tool: Array, q: Array, iterations: int = 40) -> Array:
    """Postures near q (N, n) that all hold the tool's origin where the first of them does, by damped Newton steps."""
    T = forward(chain, q) @ tool
    target = T[0, :3, 3]
    for _ in range(iterations):
        T = forward(chain, q) @ tool
        J = spatial_jacobian(chain, q)
        p = T[:, :3, 3]
        Jp = J[:, :3] + np.cross(J[:, 3:], p[:, :, None], axis=1)
        gap = target - p
        step = np.swapaxes(Jp, 1, 2) @ np.linalg.solve(Jp @ np.swapaxes(Jp, 1, 2) + 1e-9 * np.eye(3), gap[..., None])
        q = q + step[..., 0] * np.minimum(1.0, 0.5 / np.maximum(np.abs(step[..., 0]).max(axis=1, keepdims=True), 1e-12))
    return q[np.linalg.norm(gap, axis=1) < 1e-9]


def general_samples(model: Model, views: Sequence[View], each: int) -> Samples:
    """Exact readings at random postures, ``each`` per view, as the given model would make them."""
    rng = np.random.default_rng(_SEED)
    q_parts, frame, kind = [], [], []
    for view in views:
        instrument = _instrument(model, view)
        q = random_postures(model.chain, each if instrument is None else _SPARE * each, rng)
        if instrument is not None:
            scene = scene_in(model.T_frame_base[view.frame], forward(model.chain, q) @ model.T_tip_tool)
            q = q[np.argsort(~instrument.of_kind.usable(scene, instrument.values), kind="stable")[:each]]
        if view.same_point:
            q = postures_at_point(model.serial, model.T_tip_tool, random_postures(model.chain, 3 * each, rng))[:each]
        q_parts.append(q)
        frame += [view.frame] * len(q)
        kind += [view.kind] * len(q)
    return exact_samples(model, np.concatenate(q_parts), np.array(frame), np.array(kind, dtype=KIND_NAMES))


def exact_samples(model: Model, q: Array, frames: np.ndarray, kinds: np.ndarray) -> Samples:
    """Readings of these kinds (N,) in these frames (N,) at postures q (N, n), as the model's geometry makes them."""
    T = model.predict(q, frames)
    position = T[:, :3, 3]
    for instrument in model.instruments:
        rows = np.flatnonzero((frames == model.frames.index(instrument.frame)) & (kinds == instrument.kind))
        T_base_tool = forward(model.chain, q[rows]) @ model.T_tip_tool
        scene = scene_in(model.T_frame_base[model.frames.index(instrument.frame)], T_base_tool, instrument.target)
        position[rows] = instrument.of_kind.predict(scene, instrument.values)
    return Samples(
        names=model.chain.names,
        frames=model.frames,
        q=q,
        stamps=np.zeros(len(q)),
        frame=frames,
        kind=kinds,
        reading=position,
        R=np.where((kinds == POSE)[:, None, None], T[:, :3, :3], np.eye(3)),
    )


def _instrument(model: Model, view: View) -> Instrument | None:
    for instrument in model.instruments:
        if (instrument.frame, instrument.kind) == (model.frames[view.frame], view.kind):
            return instrument
    return None


@dataclass(frozen=True)
class ParameterChoice:
    """parameters: minimal and of full rank, in order of place. left_out: names whose motion others can make."""

    parameters: tuple[ModelParameter, ...]
    left_out: tuple[str, ...]


def choose_parameters(
    model: Model,
    views: Sequence[View],
    fixed: Sequence[str] = (),
    distances: Sequence[AnyDistance] = (),
    among: Callable[[ModelParameter], bool] = lambda _: True,
) -> ParameterChoice:
    """The minimal, full-rank parameters for this model and these views.

    fixed: names, places or patterns that must stay as they are. distances: known distances between frames, which can
    make scale visible. among: which parameters to consider. Raises BadTable for a pattern that names nothing.
    """
    candidates = ordered_candidates(model.chain, model.frames, views, model.instruments, model.leaders)
    candidates = [p for p in drop_fixed(candidates, fixed) if among(p)]
    views = _counting(model, views)
    samples = general_samples(model, views, each=max(12, -(-len(candidates) // len(views))))
    model = _meet_fixed_points(model, views, samples)
    J = linearise(model, candidates, np.zeros(len(candidates)), samples).J
    if distances:
        J = np.c_[J, distance_rows(model, candidates, np.zeros(len(candidates)), distances).J]
    order = _steepest_first(model, candidates, J)
    candidates, J = [candidates[j] for j in order], J[order]
    planes = _of_planes(model)
    kept = set(independent_columns(J.T, [_NEARLY if p.frame in planes else _EXACTLY for p in candidates]).tolist())
    parameters = sorted((candidates[j] for j in kept), key=lambda p: (p.place, p.frame, p.instrument, p.direction))
    passing = (2, 5)
    every = not is_serial_arm(model.chain)
    left_out = [
        c.name for j, c in enumerate(candidates) if j not in kept and (every or c.direction in passing or c.of_arm)
    ]
    return ParameterChoice(tuple(parameters), tuple(left_out))


def _counting(model: Model, views: Sequence[View]) -> list[View]:
    """The views whose parameters are fitted: some kinds leave to priors what they cannot see."""
    out: list[View] = []
    for view in views:
        other = kinds()[view.kind].counts_as
        instrument = _instrument(model, view)
        if not other or (instrument is not None and instrument.target is not None):
            out.append(view)
        if other:
            out.append(replace(view, kind=other))
    return list(dict.fromkeys(out))


def _steepest_first(model: Model, candidates: Sequence[ModelParameter], J: Array) -> list[int]:
    """The candidates' order with the directions of planes' frames put by how much they show: a plane has three, and
    they must not be written along those that hardly move it.
    """
    order = list(range(len(candidates)))
    for f in _of_planes(model):
        for turns in (False, True):
            mine = [j for j, p in enumerate(candidates) if p.place == 0 and p.frame == f and p.turns == turns]
            for place, j in zip(mine, sorted(mine, key=lambda j: -float(np.linalg.norm(J[j]))), strict=True):
                order[place] = j
    return order


def _of_planes(model: Model) -> set[int]:
    """The frames that are planes, by index."""
    return {model.frames.index(i.frame) for i in model.instruments if i.of_kind.frame == PLANE}


def parameter_count(chain: Mechanism, samples: Samples, fixed: Sequence[str], distances: Sequence[AnyDistance]) -> int:
    """How many parameters these readings call for, wherever base and tool may turn out to be."""
    somewhere = Model(chain, samples.frames, np.tile(np.eye(4), (len(samples.frames), 1, 1)), _GENERAL_TOOL)
    if instruments := new_instruments(samples):
        # where an anchor or a plane stands must not be on a joint's axis
        somewhere = replace(
            somewhere, instruments=instruments, T_frame_base=np.stack([_GENERAL_FRAME] * len(samples.frames))
        )
    return len(choose_parameters(somewhere, views_of(samples), fixed, distances).parameters)


def _meet_fixed_points(model: Model, views: Sequence[View], samples: Samples) -> Model:
    """The model with each frame that shows a fixed point moved so that the postures of that frame hold it there."""
    T = np.array(model.T_frame_base)
    for view in views:
        if view.same_point:
            row = np.flatnonzero(samples.frame == view.frame)[:1]
            T[view.frame] = se3.transform(p=-(forward(model.serial, samples.q[row]) @ model.T_tip_tool)[0, :3, 3])
    return replace(model, T_frame_base=T)
