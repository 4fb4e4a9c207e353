"""What is trusted, when it is time to calibrate again, and readings that are written in another way."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from cells import record, samples_of

from modcal_core.calibration.store import Calibration
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.loop import calibrate
from modcal_core.measurements.samples import Samples
from modcal_core.online.supervisor import LEARNING, SUSPECTED, TRUSTED, Policy, Supervisor

BUMP = se3.exp(np.array([6e-4, 0.0, -3e-4, 0.0, 0.0, 0.0]))


@cache
def calibrated(seed: int = 3) -> Calibration:
    cell = record(seed, 60)
    return calibrate(cell.samples, cell.world.nominal, np.random.default_rng(0), look_for_effects=False).calibration


def later(count: int, seed: int = 3, bump: Array | None = None) -> Samples:
    """Samples of the same cell at other postures, after those it was calibrated from."""
    cell = record(seed, 60)
    rng = np.random.default_rng(77)
    q = rng.uniform(-1.5, 1.5, (count, 6))
    T = cell.world.tool_in_tracker(q)
    T[:, :3, 3] += 5e-5 * rng.standard_normal((count, 3))
    made = samples_of(cell.world.nominal, q, T if bump is None else T @ bump)
    return replace(made, stamps=made.stamps + 5000.0, station=made.station + 1000)


def feed(supervisor: Supervisor, samples: Samples) -> None:
    for i in range(len(samples)):
        supervisor.add(samples.select(np.array([i])))


def test_nothing_is_asked_for_while_the_model_holds() -> None:
    supervisor = Supervisor(Policy(after_change=10))
    assert supervisor.state == LEARNING
    supervisor.trust(calibrated())
    feed(supervisor, later(200))
    assert supervisor.state == TRUSTED
    assert not supervisor.wants_solve()
    assert supervisor.stations == 200


def test_a_change_asks_for_a_solve_after_so_many_stations_and_again_after_a_failure() -> None:
    supervisor = Supervisor(Policy(after_change=10))
    supervisor.trust(calibrated())
    bumped = later(60, bump=BUMP)
    asked = []
    for i in range(60):
        feed(supervisor, bumped.select(np.array([i])))
        if supervisor.wants_solve():
            asked.append(i)
            supervisor.failed()
    assert supervisor.state == SUSPECTED
    assert supervisor.hypothesis.place == "tool"
    gaps = np.diff(asked)
    assert 9 <= asked[0] <= 15
    assert (gaps >= 10).all()
    assert len(asked) >= 4


def test_only_a_better_result_is_trusted_unless_somebody_says_so() -> None:
    supervisor = Supervisor(Policy())
    old, new = calibrated(), calibrated(4)
    supervisor.trust(old)
    assert not supervisor.solved(new, better=False)
    assert supervisor.trusted is old
    assert supervisor.accept()
    assert supervisor.trusted is new
    assert not supervisor.accept()
    assert supervisor.solved(old, better=True)
    assert supervisor.trusted is old


def test_the_first_solve_by_itself_is_tried_again_later() -> None:
    supervisor = Supervisor(Policy(first_solve=30))
    feed(supervisor, later(29))
    assert not supervisor.wants_solve()
    feed(supervisor, replace(later(1), station=np.array([5])))
    assert supervisor.wants_solve()
    supervisor.failed()
    assert not supervisor.wants_solve()
    stations = [replace(later(1), station=np.array([i])) for i in range(6, 36)]
    for sample in stations[:-1]:
        feed(supervisor, sample)
    assert not supervisor.wants_solve()
    feed(supervisor, stations[-1])
    assert supervisor.wants_solve()


def test_to_forget_leaves_what_is_trusted() -> None:
    supervisor = Supervisor(Policy())
    supervisor.trust(calibrated())
    feed(supervisor, later(30, bump=BUMP))
    assert supervisor.state == SUSPECTED
    supervisor.reset()
    assert supervisor.state == TRUSTED
    assert supervisor.trusted is calibrated()


def test_readings_of_a_frame_that_is_not_known_are_counted_and_said_where_no_others_come() -> None:
    supervisor = Supervisor(Policy())
    supervisor.trust(calibrated())
    for sample in (replace(later(2), frames=("tracker", "second"), frame=np.array([0, 1])), later(1)):
        feed(supervisor, sample)
    assert (supervisor.live.strange, supervisor.live.estimator.taken) == (1, 2)
    assert supervisor.state == TRUSTED
    other = later(5)
    feed(supervisor, replace(other, frames=("tracker", "second"), frame=np.ones(5, int)))
    assert supervisor.hypothesis.sentence.startswith("frame 'second' is read in place of tracker: ")
    assert not supervisor.wants_solve()


FLIP = np.diag([1.0, -1.0, 1.0])


def inverse(s: Samples) -> tuple[Array, Array]:
    R = np.swapaxes(s.R, 1, 2)
    return -np.einsum("nij,nj->ni", R, s.reading), R


def left_handed(s: Samples) -> tuple[Array, Array]:
    return s.reading @ FLIP, s.R


def millimetres(s: Samples) -> tuple[Array, Array]:
    return 1e3 * s.reading, s.R


def followed(samples: Samples) -> Supervisor:
    supervisor = Supervisor(Policy(after_change=20))
    supervisor.trust(calibrated())
    feed(supervisor, samples)
    return supervisor


@pytest.mark.parametrize(
    ("written", "words"),
    [
        (inverse, "readings look like inverse poses"),
        (millimetres, "positions look like millimetres"),
    ],
)
def test_what_is_written_in_another_way_is_named_and_not_solved(written, words: str) -> None:  # type: ignore[no-untyped-def]
    good = later(40)
    position, R = written(good)
    supervisor = followed(replace(good, reading=position, R=R))
    assert supervisor.state == SUSPECTED
    assert words in supervisor.hypothesis.sentence
    assert supervisor.hypothesis.place == "tracker"
    assert not supervisor.wants_solve()


def test_a_few_readings_leave_it_open() -> None:
    good = later(40)
    position, R = left_handed(good)
    few = followed(replace(good, reading=position, R=R).select(np.arange(4)))
    assert "It may as well be readings in another unit or convention" in few.hypothesis.sentence


@pytest.mark.parametrize(
    ("bump", "place"), [(BUMP, "tool"), (se3.exp(np.array([0.0, 0.1, 0.2, 0.0, 0.0, 1.2])), "tool")]
)
def test_a_tool_that_moved_is_a_tool_however_far(bump: Array, place: str) -> None:
    supervisor = followed(later(40, bump=bump))
    assert (supervisor.hypothesis.place, supervisor.hypothesis.mistake) == (place, False)
    assert supervisor.wants_solve()


def test_a_tool_that_was_turned_over_is_said_with_its_angle() -> None:
    supervisor = followed(later(40, bump=se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.5]))))
    assert supervisor.hypothesis.sentence.startswith("The tool or the target has moved: ")
    assert " and 28." in supervisor.hypothesis.sentence
