"""Parts of a recording with a base or a tool of their own, readings that are shifted, and what stands still."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from case import Case, calibrated, frozen, kind
from scipy.spatial.transform import Rotation
from workcell import PERIOD, Session, Works, from_, joined, until

TOOL, BASE = (r"\btool\b",), (r"\bbase\b", r"\btracker\b")
EITHER = (*TOOL, *BASE)
LEFT_OUT = ("reject", "left out", "outlier", "plainly wrong", "shift", "apart")


@kind()
def tool_turned_early(w: Works, rng: np.random.Generator) -> Case:
    """The tool is turned by 0.1 rad after a seventh of the stations."""
    session = w.clean(180, w.tool(np.zeros(3), w.way(0.1), from_(25)))
    return calibrated(session, TOOL)


@kind()
def first_twelve_with_another_tool(w: Works, rng: np.random.Generator) -> Case:
    """The first twelve stations were measured with another tool."""
    return calibrated(w.clean(120, w.tool(w.way(0.03), w.way(0.2), until(12))), TOOL)


@kind()
def last_ten_with_another_tool(w: Works, rng: np.random.Generator) -> Case:
    """The last ten stations were measured with another tool."""
    return calibrated(w.clean(120, w.tool(w.way(0.05), w.way(0.3), from_(110))), TOOL)


@kind()
def base_moved_midway(w: Works, rng: np.random.Generator) -> Case:
    """The tracker is put elsewhere in the middle: some centimetres and a degree."""
    return calibrated(w.clean(140, w.base(w.way(0.05), w.way(0.02), from_(70))), BASE)


@kind()
def base_moved_far(w: Works, rng: np.random.Generator) -> Case:
    """The tracker is put a metre aside and turned by 40 degrees."""
    return calibrated(w.clean(140, w.base(w.way(1.0), w.way(0.7), from_(int(rng.integers(40, 100))))), BASE)


@kind()
def base_moved_a_little(w: Works, rng: np.random.Generator) -> Case:
    """The tracker is knocked by a few tenths of a millimetre."""
    return calibrated(w.clean(140, w.base(w.way(4e-4), w.way(2e-4), from_(int(rng.integers(40, 100))))), BASE)


@kind()
def three_tools(w: Works, rng: np.random.Generator) -> Case:
    """The tool is changed twice."""
    bends = w.tool(w.way(0.04), w.way(0.1), from_(60)), w.tool(w.way(0.03), w.way(0.3), from_(120))
    return calibrated(w.clean(180, *bends), TOOL)


@kind()
def base_and_tool(w: Works, rng: np.random.Generator) -> Case:
    """The tracker is moved at one time, the tool at another."""
    bends = w.base(w.way(0.2), w.way(0.1), from_(50)), w.tool(w.way(0.01), w.way(0.05), from_(110))
    return calibrated(w.clean(170, *bends), EITHER)


@kind()
def tool_for_a_while(w: Works, rng: np.random.Generator) -> Case:
    """A probe is mounted for a stretch in the middle, and taken off again."""

    def while_(stations):  # type: ignore[no-untyped-def]
        k = np.arange(len(stations.t))
        return (k >= 60) & (k < 95)

    return calibrated(w.clean(150, w.tool(w.way(0.02), w.way(0.05), while_)), TOOL)


def _two(w: Works, *bends) -> tuple[Session, Session]:  # type: ignore[no-untyped-def]
    return w.clean(90), w.clean(90, *bends, begin=90 * PERIOD + 600.0)


def _also(first: Session, second: Session, must_name: tuple[str, ...]) -> Case:
    steps = (("calibrate", "{first}", "--also", "{second}"),)
    return Case({"first": first, "second": second}, steps, True, must_name)


@kind()
def joined_with_another_tool(w: Works, rng: np.random.Generator) -> Case:
    """--also a recording that was made with another tool."""
    return _also(*_two(w, w.tool(w.way(0.05), w.way(0.5), from_(0))), TOOL)


@kind()
def joined_with_the_base_moved(w: Works, rng: np.random.Generator) -> Case:
    """--also a recording before which the tracker was moved."""
    return _also(*_two(w, w.base(w.way(0.4), w.way(0.2), from_(0))), BASE)


@kind()
def joined_in_one_bag(w: Works, rng: np.random.Generator) -> Case:
    """Two recordings with different tools in one bag."""
    return calibrated(joined(*_two(w, w.tool(w.way(0.02), w.way(0.1), from_(0)))), TOOL)


def shifted(session: Session, share: float, size: float, rng: np.random.Generator) -> Session:
    """Some of the stations read elsewhere by the same vector."""
    rows = rng.permutation(len(session)) < share * len(session)
    v = rng.normal(size=3)
    p = session.p + np.where(rows[:, None], size * v / np.linalg.norm(v), 0.0)
    return replace(session, p=p)


@kind()
def near_half_shifted_frozen(w: Works, rng: np.random.Generator) -> Case:
    """A frozen model on a recording of which 45 % is shifted by 5 mm."""
    return frozen(w.clean(120), shifted(w.clean(100), 0.45, 5e-3, rng), LEFT_OUT)


@kind()
def more_than_half_shifted_frozen(w: Works, rng: np.random.Generator) -> Case:
    """A frozen model on a recording of which 55 % is shifted by 5 mm."""
    return frozen(w.clean(120), shifted(w.clean(100), 0.55, 5e-3, rng), (*LEFT_OUT, *BASE))


@kind()
def near_half_shifted_fitted(w: Works, rng: np.random.Generator) -> Case:
    """45 % of the stations that are fitted are shifted by 5 mm."""
    return calibrated(shifted(w.clean(140), 0.45, 5e-3, rng), (*LEFT_OUT, *BASE))


@kind()
def every_eighth_off(w: Works, rng: np.random.Generator) -> Case:
    """An eighth of the readings is off, each by millimetres of its own."""
    session = w.clean(140)
    rows = rng.permutation(len(session)) < len(session) // 8
    off = rng.normal(0, 3e-3, session.p.shape) * rows[:, None]
    return calibrated(replace(session, p=session.p + off), LEFT_OUT)


@kind()
def run_of_wrong_readings(w: Works, rng: np.random.Generator) -> Case:
    """Nine neighbours are off, each by millimetres of its own: the target was loose for a while."""
    session = w.clean(140)
    rows = np.abs(np.arange(len(session)) - int(rng.integers(20, 120))) < 5
    off = rng.normal(0, 4e-3, session.p.shape) * rows[:, None]
    return calibrated(replace(session, p=session.p + off), (*LEFT_OUT, "neighbour", "stations"))


@kind()
def tracker_stands_still(w: Works, rng: np.random.Generator) -> Case:
    """The tracker repeats its last reading for a fifth of the stations."""
    session = w.clean(140)
    k = int(rng.integers(30, 100))
    rows = np.r_[np.arange(k), np.full(28, k), np.arange(k + 28, len(session))]
    held = replace(session, p=session.p[rows], R=session.R[rows])
    return calibrated(held, ("stands still|stood still|still while", "frozen", "same reading", "tracker", "repeat"))


@kind()
def tracker_stood_still_frozen(w: Works, rng: np.random.Generator) -> Case:
    """A frozen model on a recording in which the tracker stood still for a third."""
    session = w.clean(90)
    rows = np.r_[np.arange(40), np.full(30, 40), np.arange(70, len(session))]
    held = replace(session, p=session.p[rows], R=session.R[rows])
    return frozen(w.clean(120), held, ("still", "frozen", "same reading", "tracker", "reject", "left out"))


@kind()
def joint_states_stale(w: Works, rng: np.random.Generator) -> Case:
    """All joints keep their values for a part of the stations while the tool moves."""
    session = w.clean(140)
    k = int(rng.integers(30, 90))
    rows = np.r_[np.arange(k), np.full(25, k), np.arange(k + 25, len(session))]
    return calibrated(replace(session, q=session.q[rows]), ("joint", "reject", "stale", "still"))


@kind()
def one_joint_stale(w: Works, rng: np.random.Generator) -> Case:
    """One joint keeps its value from the middle on."""
    session, i = w.clean(140), w.any_joint()
    q = session.q.copy()
    q[70:, i] = q[70, i]
    return calibrated(replace(session, q=q), (w.names[i], "reject"))


@kind()
def frames_alternate(w: Works, rng: np.random.Generator) -> Case:
    """Two trackers write under one name, in turns of some twenty stations."""

    def turns(stations):  # type: ignore[no-untyped-def]
        return (np.arange(len(stations.t)) // 20) % 2 == 1

    return calibrated(w.clean(160, w.base(w.way(0.5), w.way(0.4), turns)), BASE)


@kind()
def frames_change_at_random(w: Works, rng: np.random.Generator) -> Case:
    """Two trackers write under one name, whichever sees the tool."""
    rows = rng.random(150) < 0.5
    session = w.clean(150, w.base(w.way(0.1), w.way(0.05), lambda stations: rows[: len(stations.t)]))
    return calibrated(session, (*BASE, *LEFT_OUT))


@kind()
def sorted_by_the_first_joint(w: Works, rng: np.random.Generator) -> Case:
    """Stations are sorted by rings of joint 1, which is off by its own amount in every ring."""
    q, _ = w.postures(160, 0)
    rings = np.linspace(*w.arm.range[:, 0], 8)
    q[:, 0] = np.repeat(rings, 20)
    off = rng.normal(0, 6e-4, 8)
    session = w.observe(q, None, w.joint(0, lambda s: off[np.argmin(np.abs(s.q[:, :1] - rings), axis=1)]))
    return calibrated(session, (w.names[0],), floor=False)


@kind()
def clock_off_by_a_station(w: Works, rng: np.random.Generator) -> Case:
    """From the middle on every reading belongs to the posture before."""
    session = w.clean(140)
    rows = np.r_[np.arange(70), np.arange(69, len(session) - 1)]
    return calibrated(replace(session, p=session.p[rows], R=session.R[rows]))


@kind()
def readings_shuffled(w: Works, rng: np.random.Generator) -> Case:
    """Readings belong to other postures than they stand beside."""
    session = w.clean(120)
    rows = rng.permutation(len(session))
    return calibrated(replace(session, p=session.p[rows], R=session.R[rows]))


@kind()
def nonsense(w: Works, rng: np.random.Generator) -> Case:
    """Random poses."""
    session = w.clean(100)
    N = len(session)
    return calibrated(replace(session, p=rng.uniform(-1, 1, (N, 3)), R=Rotation.random(N, rng=rng)))
