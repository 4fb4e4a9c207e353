"""Where the arm's base and tool are, with the arm itself taken as it stands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from modcal_core.calibration.distances import AnyDistance, StationDistance
from modcal_core.calibration.identify import FITTED, Fit, identify
from modcal_core.calibration.initial import locate, locate_base
from modcal_core.calibration.locate_instruments import Known
from modcal_core.calibration.model import Model, place_model
from modcal_core.calibration.moves import Move, What, identify_moved
from modcal_core.calibration.parameters import ModelParameter, with_prior
from modcal_core.calibration.stated import Stated
from modcal_core.calibration.stated_places import StatedTool, stated_std, stated_tool
from modcal_core.calibration.structure import choose_parameters, views_of
from modcal_core.errors import BadTable
from modcal_core.measurements.samples import Samples
from modcal_core.robots.mechanism import Mechanism
from modcal_core.robots.urdf_inertias import Inertias

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

    def met(self, samples: Samples) -> Cell:
        """The same with the stations found that distances are known between; raises BadTable where one is not there."""
        found = (d.met(samples) if isinstance(d, StationDistance) else d for d in self.distances)
        return replace(self, distances=tuple(found))

    def require_frames(self, frames: Sequence[str]) -> None:
        """Raises BadTable for something known of a frame that no reading came in."""
        stated = [(k.frame, k.to) for k in self.known]
        for name in dict.fromkeys(
            [*(n for pair in stated for n in pair if n != "base"), *self.own_target, *self.sockets]
        ):
            if name not in frames:
                said = f"no reading has the frame '{name}'"
                raise BadTable("cell file", said, f"name frames of the recording: {', '.join(frames)}")
        for distance in self.distances:
            if isinstance(distance, StationDistance):
                continue
            for name in distance.between:
                if name not in frames:
                    raise BadTable(
                        f"known distance {' to '.join(distance.between)}",
                        f"no reading has the frame '{name}'",
                        f"name frames of the recording: {', '.join(frames)}",
                    )


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
            raise BadTable(
                f"frame '{name}' of the recording",
                f"the calibration knows only {', '.join(model.frames)}",
                "give --refit-base to find the base again",
            )
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
