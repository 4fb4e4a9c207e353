"""Two explanations that a recording cannot tell apart: both are named, and the stations proposed settle it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import yaml
from cells import record, samples_of, ur10
from robots.test_kinematics import urdf

from modcal_core.calibration.model import Model
from modcal_core.calibration.noise import NoiseModel
from modcal_core.calibration.store import Calibration, to_data
from modcal_core.effects.drivers import NominalArm
from modcal_core.effects.effect import AXIS, Effect
from modcal_core.effects.shapes import Shape
from modcal_core.files import to_yaml
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.loop import Solution, calibrate
from modcal_core.measurements.samples import Samples
from modcal_core.planning.rivals import DecidingStations, pool_near, propose, undecided_by_posture
from modcal_core.planning.site import Site, clearance, site_from_data, spheres_of, visible
from modcal_core.robots.urdf_inertias import read_inertias
from modcal_nodes.cli.main import run
from modcal_nodes.cli.plan import _worth

pytestmark = pytest.mark.slow

WRIST_1, WRIST_2 = 3, 4
RATIO, COUPLING = ("gear_ratio", "position:wrist_2_joint"), ("coupling", "position:wrist_1_joint")


def proposed(calibration: Calibration, count: int) -> DecidingStations:
    rng = np.random.default_rng(0)
    return propose(calibration, 0, 0, count, rng, pool_near(calibration, Site(), rng))


class Cell:
    """An arm in MuJoCo whose second wrist joint errs: by its own angle, or by that of the joint before it."""

    def __init__(self, truth: int) -> None:
        self.truth = truth
        self.made = record(11, 160)
        self.rng = np.random.default_rng(12)

    def measure(self, q: Array, start: float) -> Samples:
        actual = q + 1e-5 * self.rng.standard_normal(q.shape)
        actual[:, WRIST_2] += 3e-4 * q[:, self.truth]
        T = self.made.world.tool_in_tracker(actual)
        T[:, :3, 3] += 2e-5 * self.rng.standard_normal((len(q), 3))
        samples = samples_of(ur10(), q, T)
        return replace(samples, stamps=start + 2.0 * np.arange(len(q)))

    def first(self) -> Samples:
        """Both joints were only ever moved together."""
        q = self.made.samples.q.copy()
        q[:, WRIST_1] = q[:, WRIST_2] + 1e-4 * self.rng.standard_normal(len(q))
        return self.measure(q, 1.7e9)


def solve(samples: Samples) -> Solution:
    return calibrate(samples, ur10(), np.random.default_rng(0), inertias=read_inertias(urdf("ur10"), ur10()))


@cache
def undecided(truth: int) -> Solution:
    return solve(Cell(truth).first())


@pytest.mark.parametrize(("truth", "name"), [(WRIST_2, RATIO), (WRIST_1, COUPLING)])
def test_the_proposed_stations_decide(truth: int, name: tuple[str, str]) -> None:
    cell, before = Cell(truth), undecided(truth)
    finding = before.report.effects[0]
    both = [f"{finding.place} {finding.direction} by {finding.driver}", *finding.same_as]
    assert any(text.endswith(RATIO[1]) for text in both)
    assert any(text.endswith(COUPLING[1]) for text in both)

    proposal = proposed(before.calibration, 20)
    assert proposal.decides
    more = cell.measure(proposal.q, 1.7e9 + 1000.0)
    after = solve(cell.first().followed_by(more))
    finding = after.report.effects[0]
    assert (finding.family, finding.driver) == name
    assert not any(text.endswith((RATIO[1], COUPLING[1])) for text in finding.same_as)


def test_the_command_writes_stations(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    result = undecided(WRIST_2)
    (tmp_path / "found").mkdir()
    (tmp_path / "found" / "calibration.yaml").write_text(to_yaml(to_data(result.calibration)))
    report = tmp_path / "found" / "report.json"
    report.write_text("{}")
    assert run(["plan", "--decide", str(report), "--out", str(tmp_path / "plan")]) == 0
    plan = yaml.safe_load((tmp_path / "plan" / "plan.yaml").read_text())
    assert plan["joints"] == list(ur10().names)
    tie = plan["ties"][0]
    assert len(tie["between"]) == 2
    stations = np.array([s["position"] for s in tie["stations"]])
    assert (stations >= ur10().lower).all()
    assert (stations <= ur10().upper).all()
    assert np.abs(stations[:, WRIST_1] - stations[:, WRIST_2]).max() > 0.5
    assert "or" in capfd.readouterr().out
    only_there(tmp_path, report)


def only_there(tmp_path: Path, report: Path) -> None:
    """With a site, only what is free and seen is proposed."""
    written = {"tracker": {"position_m": [3.0, 0.0, 0.5]}, "surroundings": {"floor_m": 0.0}}
    (tmp_path / "site.yaml").write_text(to_yaml(written))
    arguments = ["--site", str(tmp_path / "site.yaml"), "--out", str(tmp_path / "seen")]
    assert run(["plan", "--decide", str(report), *arguments]) == 0
    plan = yaml.safe_load((tmp_path / "seen" / "plan.yaml").read_text())
    q = np.array([s["position"] for tie in plan["ties"] for s in tie["stations"]])
    site = site_from_data(written, "site")
    spheres = spheres_of(ur10(), site)
    assert len(q) == 16
    assert (clearance(spheres, site, q) >= 0.0).all()
    assert visible(spheres, site, q).all()


def test_nothing_to_decide_is_said(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    result = solve(record(13, 160).samples)
    (tmp_path / "calibration.yaml").write_text(to_yaml(to_data(result.calibration)))
    assert run(["plan", "--decide", str(tmp_path)]) == 2
    assert "no effect in it has a rival" in capfd.readouterr().err


def tied(effect: Effect, rival: Effect, weighed: bool = True) -> Calibration:
    """A calibration with an effect and a rival, and what it was made from."""
    chain = ur10()
    made = record(11, 80)
    nominal = Model(chain, ("tracker",), np.eye(4)[None], se3.exp([0.05, 0, 0.1, 0, 0.3, 0]))
    inertias = read_inertias(urdf("ur10"), chain) if weighed else None
    model = replace(nominal, arm=NominalArm(chain, inertias)).with_effects((effect,))
    seen = np.stack([made.samples.q.min(axis=0), made.samples.q.max(axis=0)])
    noise = NoiseModel(2e-5, 2e-5)
    return Calibration(nominal, model, nominal, seen, rivals=((rival,),), postures=made.samples.q, noise=noise)


def joint_effect(
    family: str, driver: str, amplitudes: list[float], shape: Shape, place: str = "elbow_joint", direction: str = AXIS
) -> Effect:
    settings = [shape.settings[name] for name in shape.refined]
    return Effect(family, place, direction, driver, shape).with_values(np.array([*amplitudes, *settings]))


RIPPLE = joint_effect("gear_harmonic", "position:elbow_joint", [2e-5, 0.0], Shape("sine", {"cycles": 65.0}))
PAYLOAD = joint_effect("payload", "load:elbow_joint,payload:elbow_joint", [1e-7, 1e-7], Shape("several"))
SPRING = joint_effect("compliance", "load:elbow_joint", [5e-6], Shape("linear"))
BY_EFFORT = joint_effect("compliance", "effort:elbow_joint", [-5e-6], Shape("linear"))


def test_what_differs_by_little_is_not_called_the_same() -> None:
    """A ripple of 65 cycles and a payload are no one motion, however small they are; stations enough tell them apart."""
    calibration = tied(RIPPLE, PAYLOAD)
    few = proposed(calibration, 3)
    assert not few.decides
    assert not few.same
    assert few.needed > 3
    assert proposed(calibration, 2 * few.needed).decides
    said = _worth(few)
    assert "same motion" not in said
    assert f"about {few.needed} are needed" in said


def test_one_motion_under_two_names_is_said_to_be_one() -> None:
    """A turn about the last axis, behind the joint or at the tool that is mounted along it."""
    turn = joint_effect("gear_ratio", "position:elbow_joint", [3e-4], Shape("linear"), "wrist_3_joint")
    tool = joint_effect("unknown", "position:elbow_joint", [3e-4], Shape("linear"), "tool", "rz")
    calibration = tied(turn, tool)
    tip = replace(calibration.calibrated, T_tip_tool=np.eye(4))
    proposal = proposed(replace(calibration, calibrated=tip), 10)
    assert proposal.same
    assert "the same motion" in _worth(proposal)


def test_effort_at_new_postures_is_not_known() -> None:
    """That gravity stands in for it must not make the two one motion."""
    proposal = proposed(tied(SPRING, BY_EFFORT), 10)
    assert not proposal.decides
    assert "same motion" not in _worth(proposal)
    assert "beyond gravity" in _worth(proposal)
    unweighed = tied(RIPPLE, BY_EFFORT, weighed=False)
    assert "is not known" in undecided_by_posture(unweighed, 0, 0)
    assert undecided_by_posture(tied(RIPPLE, PAYLOAD), 0, 0) == ""


CARRIED = joint_effect(
    "compliance",
    "load:elbow_joint,payload:elbow_joint,signal:/payload_kg",
    [5e-6],
    Shape("carried"),
)


@pytest.mark.parametrize(("effect", "rival"), [(SPRING, CARRIED), (CARRIED, SPRING), (CARRIED, RIPPLE)])
def test_a_payload_that_a_topic_tells_is_decided_by_other_payloads(
    effect: Effect, rival: Effect, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """No posture carries another mass: the sentence names the recorded number, and no stations are written."""
    calibration = tied(effect, rival)
    assert undecided_by_posture(calibration, 0, 0) == "record stations with other values of /payload_kg"
    (tmp_path / "calibration.yaml").write_text(to_yaml(to_data(calibration)))
    assert run(["plan", "--decide", str(tmp_path), "--out", str(tmp_path / "plan")]) == 0
    said = " ".join(capfd.readouterr().out.split())
    assert "postures cannot decide this: record stations with other values of /payload_kg" in said
    assert "same motion" not in said
    assert not (tmp_path / "plan").exists()
