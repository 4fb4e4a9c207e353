"""What a recording must have before anything is computed from it: each refusal names offender, limit and remedy."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np

from modcal_core.errors import BadRecording
from modcal_core.geometry import Array
from modcal_core.measurements.kinds.kind import FARTHEST
from modcal_core.measurements.kinds.registry import kinds
from modcal_core.measurements.recording import (
    IMPORTED,
    PART,
    UNREAD,
    JointTrack,
    ReadingTrack,
    Recording,
    SignalTrack,
    noted,
)
from modcal_core.measurements.samples import Samples
from modcal_core.robots import Mechanism

# --- Refusals of what was imported from tables: the remedy lies in the mapping, for nobody can record it again

# What is said of a bag that was recorded, and what to do where it was imported
_IN_THE_MAPPING = {
    "record radians": "correct the unit of joints",
    "record metres": "correct the unit of lengths",
    "correct the names in joint_states": "correct the columns of joints",
    "check that the URDF, --base and --tip are those of this robot, and that joint and tracker clocks agree": (
        "check that the URDF, --base and --tip are those of this robot, and correct columns and units"
    ),
}


@contextmanager
def remedies_of(notes: Sequence[str]) -> Iterator[None]:
    """Refusals from within say what to do about a recording with these notes."""
    try:
        yield
    except BadRecording as error:
        mappings = noted(notes, IMPORTED)
        if not mappings or error.remedy not in _IN_THE_MAPPING:
            raise
        remedy = f"{_IN_THE_MAPPING[error.remedy]} in {mappings[0]}, and import again"
        raise BadRecording(error.offender, error.limit, remedy) from error


# Beyond these a revolute joint is suspected of degrees: one with limits in the URDF, and one that turns on [rad].
MAX_TURNS = 2.0 * np.pi * 1.05
MAX_TURNS_ENDLESS = 50.0
_COUNTED_ON = 4.0 * np.pi  # what a joint may have turned on since its counter was set [rad]: two turns
_MIN_MESSAGES = 50
_JUMP, _FASTEST = 0.05, 3.0  # rad, rad/s; a joint that goes so far so fast does not come back within
_AT_ONCE, _BACK = 0.3, 0.2  # s, to within this share of the way
_OFTEN = 0.05  # share of the messages; single ones are an encoder's glitches
_MOVES = 1e-3  # rad or m; a joint that moves by less stands still
_SHOWN = 12  # topics in a refusal
POSITIONS = "tracker/pose or tracker/point"


def joint_limits(chain: Mechanism) -> Array:
    """The largest position [rad, m] of each joint, (n,), beyond which degrees or millimetres are suspected."""
    stated = np.maximum(np.abs(chain.lower), np.abs(chain.upper))
    turns = np.where(np.isfinite(stated), np.maximum(MAX_TURNS, 1.05 * stated), MAX_TURNS_ENDLESS)
    return np.asarray(np.where(chain.revolute, turns, FARTHEST))


def require_usable(recording: Recording, chain: Mechanism) -> None:
    """Raises BadRecording unless there are joint states of every joint, and readings, in SI units.

    What is not finite, and single values that cannot be, have been left out before (see ``dropouts``).
    """
    with remedies_of(recording.warnings):
        _require_joints(recording, chain)
        _require_readings(recording, chain)


def _require_joints(recording: Recording, chain: Mechanism) -> None:
    tracks = [t for t in recording.joints if len(t.stamps)]
    if not tracks:
        remedy = "record the topic, or check its name and QoS"
        remedy = _stated(recording, "joint_states") or remedy + _there(recording)
        raise BadRecording("joint states", "no message on joint_states", remedy)
    known = sorted({name for t in tracks for name in t.names})
    missing = [name for name in chain.names if name not in known]
    if missing:
        remedy = "record every joint between base and tip, or give --base and --tip of the joints recorded"
        raise BadRecording(f"joint {', '.join(missing)}", f"not among the joint states ({', '.join(known)})", remedy)
    for track in tracks:
        for j, name in enumerate(track.names):
            if name in chain.names:
                _require_joint(track, j, name, chain)
        _require_one_source(track, chain)


def _require_joint(track: JointTrack, j: int, name: str, chain: Mechanism) -> None:
    position = track.position[:, j]
    k = chain.names.index(name)
    largest = float(np.abs(position).max())
    limit = float(joint_limits(chain)[k])
    if largest <= limit:
        return
    if chain.revolute[k]:
        said = f"position reaches {largest:.1f} rad, {limit:.1f} rad is the limit: it looks like degrees"
        if largest > limit + _COUNTED_ON:
            raise BadRecording(f"joint {name}", said, "record radians")
        remedy = "record radians, within the joint's range, or correct its limits in the URDF"
        raise BadRecording(f"joint {name}", f"{said}, or whole turns were counted on", remedy)
    raise BadRecording(f"joint {name}", f"slides by {largest:.0f} m: it looks like millimetres", "record metres")


def _require_one_source(track: JointTrack, chain: Mechanism) -> None:
    """Raises BadRecording where positions jump to and fro between messages: two nodes publish them under one name."""
    mine = [j for j, name in enumerate(track.names) if name in chain.names and chain.revolute[chain.names.index(name)]]
    if len(track.stamps) < _MIN_MESSAGES or not mine:
        return
    # in the order in which they came: a clock that is set back would shuffle those of one node
    step = np.diff(track.position[:, mine], axis=0)
    seconds = np.maximum(np.abs(np.diff(track.stamps)), 1e-6)[:, None]
    away = (np.abs(step[:-1]) > _JUMP) & (np.abs(step[:-1]) > _FASTEST * seconds[:-1])
    back = (np.abs(step[:-1] + step[1:]) < _BACK * np.abs(step[:-1])) & (seconds[:-1] + seconds[1:] < _AT_ONCE)
    share = (away & back).mean(axis=0)
    if share.max() > _OFTEN:
        said = f"jumps to and fro at {share.max():.0%} of the messages: two nodes publish joint states"
        remedy = "stop the other one (a joint_state_publisher?), or record the driver's topic under a name of its own"
        raise BadRecording(f"{track.topic}: the position of {track.names[mine[int(np.argmax(share))]]}", said, remedy)


def _require_readings(recording: Recording, chain: Mechanism) -> None:
    tracks = [r for r in recording.readings if len(r.stamps) and r.kind in kinds()]
    if not tracks:
        unread = noted(recording.warnings, UNREAD)
        raise BadRecording(
            "tracker",
            f"no message on {POSITIONS}, nor on {', '.join(k.topic for k in kinds().values() if not k.direct)}",
            _stated(recording, "tracker/pose", "tracker/point")
            or (f"there are {unread[0]}" if unread else "")
            or "check that the tracker runs and sees its target, and the topic's name and QoS" + _there(recording),
        )
    for track in tracks:
        _require_reading(track, chain, recording)


def _stated(recording: Recording, *roles: str) -> str:
    """The remedy where topics are there that could play one of these roles; nothing where there are none."""
    seen: dict[str, None] = {}
    for one in recording.listed:
        if one.role is not None or one.count == 0:
            continue
        if "tf" in one.could:
            if "tracker/pose" in roles:
                seen["--tf PARENT:CHILD"] = None
        elif fitting := [role for role in roles if role in one.could]:
            seen[f"--topic {fitting[0]}={one.topic}"] = None
    if not seen:
        return ""
    return "state which it is, if one of these measures it: " + ", ".join(seen)


def _there(recording: Recording) -> str:
    """What topics there are, where it is known."""
    kinds = [(one.topic, one.type_name.rpartition("/")) for one in recording.listed]
    names = [f"{topic} ({kind}{'' if ros else ', no type of ROS 2'})" for topic, (_, ros, kind) in kinds]
    more = f", and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return f"; recorded are {', '.join(names[:_SHOWN])}{more}" if names else ""


def _require_reading(track: ReadingTrack, chain: Mechanism, recording: Recording) -> None:
    name = f"{track.topic} ({track.frame})"
    if (complaint := kinds()[track.kind].complaint(track, chain.reach())) is None:
        return
    beside = _moving_beside(recording, chain.names)
    if len(beside) > chain.n:  # the chain is a small part of what moves: the way to the tip ended too early
        listed = ", ".join(beside)
        raise BadRecording(
            name,
            f"{complaint[0].partition(': it looks')[0]}; only {', '.join(chain.names)} "
            f"{'is' if chain.n == 1 else 'are'} between {chain.base} and {chain.tip}, and {listed} moved as well",
            "give --tip as the link that carries the target; an arm ends before a joint that mimics another "
            "or is mimicked: where that joint has a motor of its own, remove its <mimic> tag",
        )
    raise BadRecording(name, *complaint)


# --- Joints that are recorded beside the arm's own: another arm, a gantry, a gripper. They may move the tool too

_MARK = f"{PART}joint "


def _moving_beside(recording: Recording, names: Sequence[str]) -> dict[str, tuple[JointTrack, int]]:
    """Recorded joints that move and are none of these, by name: where they stand."""
    found: dict[str, tuple[JointTrack, int]] = {}
    for track in recording.joints:
        for j, name in enumerate(track.names):
            known = track.position[np.isfinite(track.position[:, j]), j]
            if name not in names and len(known) and np.ptp(known) > _MOVES:
                found.setdefault(name, (track, j))
    return found


def other_joints(recording: Recording, samples: Samples) -> tuple[SignalTrack, ...]:
    """For each joint of a recording, on the clock of the samples, that moves and is none of the arm's its position
    [rad or m] at the samples.
    """
    at, found = np.unique(samples.stamps), list[SignalTrack]()
    for name, (track, column) in _moving_beside(recording, samples.names).items():
        known = np.isfinite(track.position[:, column])
        order = np.argsort(track.stamps[known], kind="stable")
        value = np.interp(at, track.stamps[known][order], track.position[known, column][order])
        if np.ptp(value) > _MOVES:
            found.append(SignalTrack(f"signal:{track.topic}{_MARK}{name}", at, value[:, None], track.topic))
    return tuple(found)


def others_at(samples: Samples) -> Array:
    """Positions of these joints at the samples, (N, K); K is 0 where there are none."""
    columns = [np.interp(samples.stamps, track.stamps, track.values[:, 0]) for track in _others(samples)]
    return np.stack(columns, axis=1) if columns else np.empty((len(samples), 0))


def others_by_name(samples: Samples) -> dict[str, Array]:
    """Positions of these joints at the samples, (N,), by the joint's name."""
    return dict(zip(moving_beside(samples), others_at(samples).T, strict=True))


def moving_beside(samples: Samples) -> tuple[str, ...]:
    """Names of the joints that were recorded moving and are none of the arm's."""
    return tuple(spoken_name(track.name) for track in _others(samples))


def _others(samples: Samples) -> list[SignalTrack]:
    return [track for track in samples.signals if _MARK in track.name]


def spoken_name(signal: str) -> str:
    """A recorded signal as a person calls it: its topic, or the joint."""
    return signal.rpartition(_MARK)[2].removeprefix("signal:").replace("temperature:", "the temperature of ")
