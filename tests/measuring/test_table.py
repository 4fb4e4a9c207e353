"""What a technician types into a table: what is understood, what is refused, and with which words."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from cells import NOISE_M, World, ur10

from modcal_core.errors import BadTable
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.planning.advice import Advance, Advice
from modcal_core.planning.outlook import refit
from modcal_core.planning.session import MEASURED, Session, Station
from modcal_core.planning.typed_table import FilledTable, require_likely, text_of, to_table, with_table
from modcal_nodes.cli.measure import left_out

TURNS = np.ones(2, bool)
COUNT, TYPED = 14, 5  # stations, and the one whose reading is typed wrongly


@pytest.fixture
def session() -> Session:
    """Three stations of two joints, none of them measured."""
    return Session(("a", "b"), stations=tuple(Station(np.array([0.1 * k, 0.2])) for k in range(3)))


def filled(session: Session, rows: Callable[[list[str]], list[str]]) -> FilledTable:
    """The table of the session, its rows after the head changed, taken in."""
    head, *lines = to_table(session, session.pending, TURNS).splitlines()
    return with_table(session, "\n".join([head, *rows(lines)]), TURNS, "t")


def read(lines: list[str], *values: str, note: str = "") -> list[str]:
    """The first row with a reading."""
    return [lines[0].replace(",,,,", f",{','.join(values)},{note}"), *lines[1:]]


def test_rows_of_before_are_passed_over_and_say_so_where_they_differ(session: Session) -> None:
    first = filled(session, lambda lines: read(lines, "1", "2", "3"))
    assert first.read == (0,)
    text = to_table(session, session.pending, TURNS)  # the table as it was opened before
    again = with_table(first.session, text.replace("0.20000", "0.2").replace(",,,,", ",1.0,2.0,3.0,", 1), TURNS, "t")
    assert again.session == first.session
    assert again.read == ()
    with pytest.raises(BadTable, match="station 1 was taken in before, with another reading"):
        with_table(first.session, text.replace(",,,,", ",1,2,4,", 1), TURNS, "t")


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        (lambda lines: [*read(lines, "1", "2", "3"), *read(lines, "1", "2", "3")], "row 5: station 1 stands in row 2"),
        (lambda lines: read(lines, "", "", "", note="behind a post"), "has no reading and says 'behind a post'"),
        (lambda lines: read(lines, "1", "2", "3", note="unseen"), "has a reading and says 'unseen'"),
        (lambda lines: read(lines, "1,5", "2,5", "3,5"), "cells, the head has 8: separate columns by semicolons"),
        (lambda lines: read(lines, "1", "2", "1 234.5"), "'1 234.5' is not a number: write one, without separators"),
    ],
)
def test_what_cannot_be_meant_is_refused(session: Session, rows: Callable[[list[str]], list[str]], said: str) -> None:
    with pytest.raises(BadTable) as refused:
        filled(session, rows)
    assert said in str(refused.value)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_files_are_read_as_spreadsheets_write_them(session: Session, encoding: str) -> None:
    head, *lines = to_table(session, session.pending, TURNS).splitlines()
    text = "\r\n".join(line.replace(",", ";").replace(".", ",") for line in [head, *read(lines, "1.5", "2", "3")])
    after = with_table(session, text_of(text.encode(encoding), "t"), TURNS, "t").session.stations[0]
    assert after.state == MEASURED
    assert after.reading == pytest.approx([1.5e-3, 2e-3, 3e-3])


def measured(change: Callable[[Array], Array] | None, every: bool = False) -> Session:
    """Stations of an arm that departs from its nominal geometry, one of the readings (or every one) changed [m]."""
    world = World(ur10(), np.random.default_rng(3))
    q = np.random.default_rng(4).uniform(-2.5, 2.5, (COUNT, 6))
    p = world.tool_in_tracker(q)[:, :3, 3] + NOISE_M * np.random.default_rng(5).standard_normal((COUNT, 3))
    if change is not None:
        p = np.array([change(row) if every or k == TYPED else row for k, row in enumerate(p)])
    return Session(ur10().names, stations=tuple(Station(a).measured(b) for a, b in zip(q, p, strict=True)))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda p: 1e-3 * p, "looks like metres: write millimetres"),
        (lambda p: p * [1, 1, 10], "look for a wrong digit or decimal point"),
        (lambda p: p + [0.12, 0, 0], "x is +1"),
        (lambda p: p + [0.3, -0.2, 0.4], "lies 539 mm from where the other 13 readings have it"),
    ],
)
def test_a_reading_that_was_typed_wrongly_is_named(change: Callable[[Array], Array], said: str) -> None:
    wrong = measured(change)
    with pytest.raises(BadTable) as refused:
        require_likely(wrong, ur10(), range(COUNT), "t")
    assert str(refused.value).startswith(f"t, station {TYPED + 1}: ")
    assert said in str(refused.value)
    require_likely(wrong, ur10(), [k for k in range(COUNT) if k != TYPED], "t")  # it was taken in before, or is checked


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda p: 1e-3 * p, "readings look like metres"),
        (lambda p: p[[1, 0, 2]], "left-handed"),
        (lambda p: p * [1, 1, -1], "left-handed"),
    ],
)
def test_readings_that_are_all_mistaken_are_named(change: Callable[[Array], Array], said: str) -> None:
    with pytest.raises(BadTable, match=said):
        require_likely(measured(change, every=True), ur10(), range(COUNT), "t")


def test_two_rows_that_were_exchanged_are_named() -> None:
    right = measured(None)
    a, b = (right.stations[k] for k in (TYPED, TYPED + 1))
    wrong = right.with_station(TYPED, replace(a, reading=b.reading)).with_station(
        TYPED + 1, replace(b, reading=a.reading)
    )
    with pytest.raises(BadTable, match=f"has what the arm should read at station {TYPED + 2}"):
        require_likely(wrong, ur10(), range(COUNT), "t")


def test_what_an_arm_may_be_off_by_is_taken() -> None:
    require_likely(measured(None), ur10(), range(COUNT), "t")
    require_likely(measured(lambda p: p + [1e-3, 0, 0]), ur10(), range(COUNT), "t")  # for the fit to judge
    # columns in another order of the same hand are another frame
    require_likely(measured(lambda p: p[[1, 2, 0]], every=True), ur10(), range(COUNT), "t")
    # a bent arm: links a tenth too long are no mistakes of typing
    origins = ur10().origins.copy()
    origins[:, :3, 3] *= 1.1
    world = World(ur10().with_origins(origins), np.random.default_rng(3))
    q = np.random.default_rng(4).uniform(-2.5, 2.5, (COUNT, 6))
    p = world.tool_in_tracker(q)[:, :3, 3] + np.random.default_rng(6).normal(0.0, 0.02, (COUNT, 3))
    far = Session(ur10().names, stations=tuple(Station(a).measured(b) for a, b in zip(q, p, strict=True)))
    require_likely(far, ur10(), range(COUNT), "t")


def test_an_orientation_that_was_typed_wrongly_is_named() -> None:
    world = World(ur10(), np.random.default_rng(3))
    q = np.random.default_rng(4).uniform(-2.5, 2.5, (COUNT, 6))
    T = world.tool_in_tracker(q)
    T[TYPED] = T[TYPED] @ se3.exp([0.0, 0.0, 0.0, 0.2, 0.0, 0.0])
    stations = tuple(Station(a).measured(b) for a, b in zip(q, se3.to_pose(T), strict=True))
    with pytest.raises(BadTable, match=rf"station {TYPED + 1}: is turned by 11\.\d°"):
        require_likely(Session(ur10().names, "pose", stations), ur10(), range(COUNT), "t")


@pytest.mark.slow
def test_a_reading_that_the_fit_leaves_out_is_said() -> None:
    session = measured(lambda p: p + [0.01, 0, 0])
    found = refit(session.samples(session.fitted), ur10(), 0, effects=False)
    said = left_out(Advice(session, "", Advance(COUNT, COUNT, 0), refitted=found))
    assert len(said) == 1
    assert said[0].startswith(f"Station {TYPED + 1} is left out of the fit: its reading lies ")
    assert 8.0 < float(said[0].partition(" mm")[0].split()[-1]) < 12.0
    right = measured(None)
    found = refit(right.samples(right.fitted), ur10(), 0, effects=False)
    assert left_out(Advice(right, "", Advance(COUNT, COUNT, 0), refitted=found)) == []
