"""Sessions from beginning to end, against arms of MuJoCo; by hand with a table; and resumed."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nodes.processes import ROOT

from modcal_core.effects.registry import candidates
from modcal_core.errors import BadTable
from modcal_core.files import parse_yaml, read_yaml, to_yaml
from modcal_core.geometry import se3
from modcal_core.planning.advice import Advice, Advisor, Method
from modcal_core.planning.next_stations import return_stations
from modcal_core.planning.pool import survey
from modcal_core.planning.rivals import deciding
from modcal_core.planning.session import (
    MEASURED,
    PROOF,
    UNSEEN,
    Goal,
    Session,
    Station,
    from_data,
    proven,
    spent,
    to_data,
)
from modcal_core.planning.site import Site, site_from_data
from modcal_core.robots.mechanism import forward
from modcal_core.robots.urdf import read_chain
from modcal_core.robots.urdf_inertias import read_inertias
from modcal_nodes.cli.main import run
from modcal_nodes.measuring.folder import CellInProcess
from modcal_nodes.ros.parameters import SIMULATED_CELL

URDF = ROOT / "examples" / "robots" / "ur10.urdf"
CHAIN = read_chain(URDF.read_text())
LIMITS = {name: (-1.8, 1.8) for name in CHAIN.names}


def cell(**chosen: Any) -> CellInProcess:
    usual = {name: p.default for name, p in SIMULATED_CELL.items()}
    given = {"measurement": "point", "noise_m": 2e-5, "seed": 3, **chosen}
    return CellInProcess({**usual, "urdf": str(URDF), **given})


def advisor(goal: Goal, **options: Any) -> Advisor:
    pool = survey(CHAIN, Site(limits=LIMITS), np.random.default_rng(0), drawn=True)
    return Advisor(CHAIN, pool, goal, Method(**options), None, read_inertias(URDF.read_text(), CHAIN))


def measured(advising: Advisor, by: CellInProcess, session: Session | None = None, until: int = 1000) -> Advice:
    session = session or Session(CHAIN.names)
    while True:
        advice = advising.advise(session)
        session = advice.session
        if advice.outcome is not None or len(session.rows()) >= until:
            return advice
        for number in session.pending:
            session = session.with_station(number, by.measure(session.stations[number]))


def true_error(advice: Advice, by: CellInProcess, rng: np.random.Generator) -> float:
    """RMS [m] over random postures: where the model has the tool, against MuJoCo."""
    q = rng.uniform(-1.8, 1.8, (200, CHAIN.n))
    exact = np.array([(by.plant.world.T_tracker_base @ by.plant.world.tool_in_base(row))[:3, 3] for row in q])
    assert advice.refitted is not None
    T = advice.refitted.calibration.calibrated.predict(q)
    return float(np.sqrt(np.mean(np.sum((T[:, :3, 3] - exact) ** 2, axis=1))))


Whole = tuple[Advice, CellInProcess]


@pytest.fixture(scope="module")
def whole() -> Whole:
    """A measurement from beginning to end, which tests only look at."""
    by = cell()
    return measured(advisor(Goal(1e-4)), by), by


@pytest.mark.slow
def test_a_goal_is_proven_and_true(whole: Whole, rng: np.random.Generator) -> None:
    advice, by = whole
    assert advice.outcome is not None
    assert advice.outcome.ending == "proven"
    assert advice.status.measured < 40
    assert advice.status.bound is not None
    assert advice.status.bound <= 1e-4
    assert true_error(advice, by, rng) <= 1e-4
    # what proved it was not fitted
    assert advice.refitted is not None
    proof = {tuple(s.asked) for s in advice.session.stations if s.role == PROOF}
    assert not proof & {tuple(q) for q in advice.refitted.samples.q}


@pytest.mark.slow
def test_what_is_proven_is_what_is_used() -> None:
    """A gear's wave is learned from twelve stations; those of the proof go beyond them, and so will those who use it."""
    by = cell(seed=7, gear_joint="elbow_joint", gear_amplitude_rad=2e-4, measurement="pose")
    pool = survey(CHAIN, Site(), np.random.default_rng(0), "pose", drawn=True)
    advising = Advisor(CHAIN, pool, Goal(1e-4), Method(), None, read_inertias(URDF.read_text(), CHAIN))
    advice = measured(advising, by, Session(CHAIN.names, "pose"))
    assert advice.outcome is not None
    assert advice.outcome.ending == "proven"
    assert advice.status.effects
    assert advice.refitted is not None
    fitted, proof = (advice.session.samples(rows) for rows in (advice.session.fitted, advice.session.rows(PROOF)))
    assert (proof.q > fitted.q.max(axis=0)).any()
    T = advice.refitted.calibration.predict(proof.q)
    left = np.linalg.norm(T[:, :3, 3] - proof.reading, axis=1)
    assert float(np.sqrt(np.mean(left**2))) == pytest.approx(advice.status.seen, rel=1e-6)
    # and where nothing was drawn the geometry that is best alone counts, as of any calibration
    assert (advice.refitted.calibration.seen[1] <= CHAIN.upper + 1e-9).all()


@pytest.mark.slow
def test_a_goal_below_what_the_arm_repeats_is_refused_with_the_reason(rng: np.random.Generator) -> None:
    by = cell(repeatability_rad=5e-5)
    advice = measured(advisor(Goal(3e-5, stations=60), effects=False), by)
    assert advice.outcome is not None
    assert advice.outcome.ending == "no_station_helps"
    assert "0.03 mm is below what can be reached" in advice.outcome.sentence
    assert "is what this arm repeats and this instrument reads, by" in advice.outcome.sentence
    assert advice.status.floor is not None
    assert 4e-5 < advice.status.floor < 1.5e-4


@pytest.mark.slow
def test_a_budget_ends_it() -> None:
    advice = measured(advisor(Goal(1e-5, stations=15), effects=False), cell())
    assert advice.outcome is not None
    assert advice.outcome.ending == "budget"
    assert advice.status.measured == 15
    assert advice.outcome.sentence.startswith("The budget is gone after 15 stations: the tool's RMS error is at most ")
    late = advisor(Goal(1e-5, seconds=10.0), effects=False).advise(advice.session, elapsed=11.0)
    assert late.outcome is not None
    assert late.outcome.ending == "budget"


def test_a_session_goes_on_from_its_file_with_the_same_stations(whole: Whole) -> None:
    """One in a piece, the other read from its file on the way, by another advisor."""
    done = whole[0].session
    early = replace(done, stations=done.stations[:12])
    data = parse_yaml(to_yaml(to_data(early, Goal(1e-4), 0, "x", None)), "s")
    session, goal, *_ = from_data(data, "s")
    advising = advisor(goal)
    while (advice := advising.advise(session)).outcome is None:
        session = advice.session
        for number in session.pending:
            assert np.array_equal(session.stations[number].asked, done.stations[number].asked)
            session = session.with_station(number, done.stations[number])
    one, two = done.stations, advice.session.stations
    assert len(one) == len(two)
    assert all(np.array_equal(a.asked, b.asked) and a.role == b.role for a, b in zip(one, two, strict=True))


@pytest.mark.slow
def test_what_is_not_seen_is_made_up_for_and_not_asked_for_again() -> None:
    """The tracker does not see the tool in front of the arm's left: stations there are given up, and fewer asked for."""
    by = cell()

    def see(station: Station) -> Station:
        T = by.plant.world.tool_in_base(station.asked)
        return replace(station, state=UNSEEN) if T[1, 3] > 0.2 else by.measure(station)

    advising, session = advisor(Goal(1e-4), effects=False), Session(CHAIN.names)
    while (advice := advising.advise(session)).outcome is None:
        session = advice.session
        for number in session.pending:
            session = session.with_station(number, see(session.stations[number]))
    assert advice.outcome.ending == "proven"
    unseen = [tuple(s.asked) for s in advice.session.stations if s.state == UNSEEN]
    assert len(unseen) > 4
    assert len(set(unseen)) == len(unseen)


def test_a_camera_on_the_tool_is_offered_what_shows_its_target_and_read_the_other_way_round() -> None:
    """Every posture offered has the whole board in view; poses of the board in the camera are those of the camera."""
    view = {"on_tool": True, "position_m": [0, 0, 0.05], "axis": [0, 0, 1], "half_angle_deg": 25, "range_m": [0.3, 0.9]}
    board = {"position_m": [0.7, 0.1, 0.0], "axis": [0, 0, 1], "half_angle_deg": 50, "radius_m": 0.1}
    site = site_from_data({"tracker": view, "target": board}, "s")
    pool = survey(CHAIN, site, np.random.default_rng(0), "pose", 100, drawn=True)
    T = forward(CHAIN, pool.q)
    T_camera = T @ se3.transform(p=[0, 0, 0.05])
    way = np.array([0.7, 0.1, 0.0]) - T_camera[:, :3, 3]
    away = np.linalg.norm(way, axis=1)
    ray = way / away[:, None]
    aside = np.degrees(np.arccos(np.sum(ray * T_camera[:, :3, 2], axis=1)) + np.arcsin(0.1 / away))
    assert (aside <= 25.0 + 1e-6).all()
    assert (np.degrees(np.arccos(-ray[:, 2])) <= 50.0 + 1e-6).all()  # tilt
    assert away.min() >= 0.3
    assert away.max() <= 0.9
    seen = se3.inverse(T_camera) @ se3.transform(p=[0.7, 0.1, 0.0])
    stations = [Station(pool.q[i]).measured(se3.to_pose(seen[i]), stamp=float(i)) for i in range(4)]
    session = Session(CHAIN.names, "pose", tuple(stations), carried=True)
    samples = session.samples([0, 1, 2, 3])
    board_camera = se3.transform(p=[-0.7, -0.1, 0.0]) @ T_camera[:4]
    assert np.allclose(samples.reading, board_camera[:, :3, 3], atol=1e-9)
    assert np.allclose(samples.R, board_camera[:, :3, :3], atol=1e-9)
    kept, *_ = from_data(parse_yaml(to_yaml(to_data(session, Goal(1e-4), 0, "x", None)), "s"), "s")
    assert kept.carried


def test_returns_come_from_another_side(whole: Whole) -> None:
    advice, by = whole
    again = return_stations(advice.session, 6)
    assert len(again) == 6
    session = advice.session.asking(again)
    for number in session.pending:
        session = session.with_station(number, by.measure(session.stations[number]))
    samples = session.samples(session.rows())
    for s in again:
        rows = np.flatnonzero(np.abs(samples.q - s.asked).max(axis=1) < 1e-9)
        assert len(rows) == 2
        assert (samples.approach[rows[0]] * samples.approach[rows[1]] < 0.0).any()


@pytest.mark.slow
def test_a_technician_with_a_spreadsheet(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Files only: the next postures are read from a table, the readings written into it, and the command given again."""
    by, folder = cell(), tmp_path / "hand"
    (tmp_path / "site.yaml").write_text(to_yaml({"limits": {n: list(v) for n, v in LIMITS.items()}}))
    arguments = ["measure", str(URDF), "--goal-mm", "0.15", "--by-hand", str(folder), "--geometry-only"]
    arguments += ["--site", str(tmp_path / "site.yaml")]
    for _ in range(20):
        code = run(arguments)
        table = folder / "next.csv"
        if not table.exists():
            break
        assert code == 0
        rows = list(csv.reader(io.StringIO(table.read_text())))
        for row in rows[1:]:
            q = np.radians([float(v) for v in row[2:8]])
            station = by.measure(Station(q))
            assert station.reading is not None
            row[8:11] = [f"{1e3 * v:.4f}".replace(".", ",") for v in station.reading]  # a decimal comma
        if len(rows) > 5:
            rows[1][8:12] = ["", "", "", "unseen"]
        table.write_text("\n".join(";".join(row) for row in rows))
    said = capsys.readouterr().out
    assert "Write each reading into its row" in said
    assert "0.15 mm is proven" in said
    assert code == 0
    result = json.loads((folder / "measure.json").read_text())
    assert result["ending"] == "proven"
    assert {"calibration.yaml", "report.html", "stations.csv", "session.yaml"} <= {p.name for p in folder.iterdir()}
    session = read_yaml(folder / "session.yaml")
    assert sum(s["state"] == MEASURED for s in session["stations"]) == result["stations"]["measured"]


def test_a_folder_of_another_goal_or_robot_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = str(tmp_path / "hand")
    assert run(["measure", str(URDF), "--goal-mm", "0.1", "--by-hand", folder]) == 0
    assert run(["measure", str(URDF), "--goal-mm", "0.2", "--by-hand", folder]) == 2
    assert "was begun with another accuracy" in capsys.readouterr().err
    other = ROOT / "examples" / "robots" / "xarm7.urdf"
    assert run(["measure", str(other), "--goal-mm", "0.1", "--by-hand", folder]) == 2
    assert "is of robot" in capsys.readouterr().err


def test_explanations_that_are_one_motion_are_told_from_those_that_stations_separate(whole: Whole) -> None:
    """A spring at the UR10's lift and at its pan's bearing, both by the lift's torque: their axes are parallel, and what
    their distance makes is taken up by geometry. A spring at the elbow is another thing."""
    refitted = whole[0].refitted
    assert refitted is not None
    model = refitted.calibration.calibrated
    lines = [
        e for e in candidates(model.drivers(refitted.samples)) if (e.family, e.shape.kind) == ("compliance", "linear")
    ]
    lift, bearing, elbow = (
        next(e for e in lines if e.label == label).started(np.array([4e-6]))
        for label in (
            "shoulder_lift_joint axis by load:shoulder_lift_joint",
            "shoulder_pan_joint across by load:shoulder_pan_joint",
            "elbow_joint axis by load:elbow_joint",
        )
    )
    calibration = replace(refitted.calibration, calibrated=model.with_effects((lift,)), rivals=((bearing, elbow),))
    pool = survey(CHAIN, Site(limits=LIMITS), np.random.default_rng(0), candidates=100, drawn=True)
    found, why = deciding(calibration, pool, 4, np.random.default_rng(0))
    assert found is not None
    assert found.name == f"{lift.label} or {elbow.label}"
    assert list(why) == [f"{lift.label} or {bearing.label}"]
    # another payload loads both alike
    (said,) = why.values()
    assert said.startswith("cannot tell")
    assert "a target on a link between them" in said
    assert "another payload" not in said


@pytest.mark.slow
def test_a_recording_is_replayed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of the stations in a bag as few are used as prove the goal, and none of them twice."""
    out = tmp_path / "replayed"
    assert (
        run(["measure", str(URDF), "--goal-mm", "0.1", "--replay", str(ROOT / "bags" / "ur10_cell"), "--out", str(out)])
        == 0
    )
    assert "0.1 mm is proven" in capsys.readouterr().out
    stations = read_yaml(out / "session.yaml")["stations"]
    rows = [s["row"] for s in stations]
    assert len(set(rows)) == len(rows) < 40
    report = json.loads((out / "report.json").read_text())
    assert report["recording"]["stations"] == sum(s["role"] == PROOF for s in stations)


def test_the_instruments_own_error_is_no_error_of_the_tool() -> None:
    assert Goal(1e-4, instrument=5e-5).rms == pytest.approx(np.hypot(1e-4, 5e-5))
    assert Goal(1.96e-4, "p95").rms == pytest.approx(1e-4)
    assert Goal().rms is None


def test_an_end_says_the_upper_end_of_the_claim() -> None:
    said = proven(Goal(1e-4), 0.083, 26, 6).sentence
    assert said.startswith(
        "0.1 mm is proven: over all postures that are allowed and seen the tool's RMS error is at most"
    )
    assert "at most 0.083 mm with 95 % confidence, from 26 stations, 6 of them at random and in no fit." in said
    gone = spent(Goal(1e-4, "p95"), 15, 0.3).sentence
    assert "95th percentile is at most 0.300 mm" in gone
    assert "too few for a fit" in spent(Goal(1e-4), 3, None).sentence


def test_what_cannot_be_asked_is_refused() -> None:
    for wrong in ({"accuracy": 0.0}, {"accuracy": np.inf}, {"stations": 0}):
        with pytest.raises(BadTable):
            Goal(**wrong)  # type: ignore[arg-type]
