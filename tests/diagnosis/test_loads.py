"""What pulls on an arm is found: the way of weight, and a payload of each recording; against MuJoCo's statics."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from cells import samples_of

from modcal_core.calibration.cell import Cell, StatedPayload
from modcal_core.calibration.store import from_data, to_data
from modcal_core.errors import BadTable
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.loop import Solution, calibrate
from modcal_core.measurements.recording import SignalTrack
from modcal_core.measurements.samples import Samples
from modcal_core.report.report import to_json_data
from modcal_core.robots.kinematics import chain_forward
from modcal_core.robots.urdf import read_chain
from modcal_core.robots.urdf_inertias import read_inertias

URDF = (Path(__file__).resolve().parents[2] / "examples" / "robots" / "ur10.urdf").read_text(encoding="utf-8")
CHAIN = read_chain(URDF, tip="tool0")
COMPLIANCE = np.array([0.0, 6e-6, 9e-6, 3e-5, 0.0, 0.0])  # rad/(N m)
GRAVITY = 9.80665
BASE, TOOL = se3.exp([1.0, 2.0, 0.3, 0.2, -0.4, 1.0]), se3.exp([0.05, 0.03, 0.12, 0.2, 0.0, 0.3])
WALL = np.array([np.sin(1.2), 0.1, -np.cos(1.2)]) / np.linalg.norm([np.sin(1.2), 0.1, -np.cos(1.2)])
DOWN = np.array([0.0, 0.0, -1.0])
CENTRE = np.array([0.0, 0.02, 0.06])  # m; of what is carried, in the flange


def torques(q: Array, down: Array, carried: float, centre: Array) -> Array:
    """What weight does to the joints, (N, 6) [N m], with a mass at a place of the flange."""
    ball = f'<link name="ball"><inertial><origin xyz="{" ".join(map(str, centre))}"/><mass value="{carried + 1e-9}"/>'
    ball += '<inertia ixx="1e-3" iyy="1e-3" izz="1e-3" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    held = '<joint name="held" type="fixed"><parent link="tool0"/><child link="ball"/></joint>'
    model = mujoco.MjModel.from_xml_string(URDF.replace("</robot>", ball + held + "</robot>"))
    model.opt.gravity[:] = GRAVITY * down
    data, out = mujoco.MjData(model), np.empty_like(q)
    for row, posture in zip(out, q, strict=True):
        data.qpos[:] = posture
        mujoco.mj_forward(model, data)
        row[:] = -data.qfrc_bias
    return out


def recorded(
    rng: np.random.Generator, count: int, down: Array = DOWN, carried: float = 0.0, compliance: Array = COMPLIANCE
) -> Samples:
    q = rng.uniform(-1.6, 1.6, (count, 6))
    bent = q + compliance * torques(q, down, carried, CENTRE)
    T = BASE @ chain_forward(CHAIN, bent) @ TOOL
    T[:, :3, 3] += 2e-5 * rng.standard_normal((count, 3))
    return samples_of(CHAIN, q, T)


def calibrated(samples: Samples, cell: Cell | None = None) -> Solution:
    return calibrate(samples, CHAIN, np.random.default_rng(0), cell, inertias=read_inertias(URDF, CHAIN))


def left(done: Solution) -> float:
    size = done.report.size_mm("final")
    assert size is not None
    return float(size.rms)


@pytest.mark.slow
def test_an_arm_on_a_wall_shows_which_way_weight_pulls(rng: np.random.Generator) -> None:
    samples = recorded(rng, 110, WALL)
    done = calibrated(samples)
    loads = done.report.loads
    assert loads is not None
    assert loads.down is not None
    off = float(np.arccos(np.clip(loads.down @ WALL, -1.0, 1.0)))
    assert off < 3.0 * loads.down_std < np.radians(3.0)
    assert loads.turned == pytest.approx(np.arccos(WALL @ DOWN), abs=0.02)
    assert left(done) < 1.25 * np.sqrt(3.0) * 0.02
    places = [
        {e.place for e in some if e.family == "compliance"} for some in (done.report.effects, done.report.unproved)
    ]
    assert {"shoulder_lift_joint", "elbow_joint"} <= places[0]
    assert places[0] | places[1] == {"shoulder_lift_joint", "elbow_joint", "wrist_1_joint"}
    assert any("Weight pulls along" in note and "state gravity" in note for note in done.report.notes)
    assert to_json_data(done.report)["loads"]["gravity"]["turned_deg"] == pytest.approx(np.degrees(loads.turned))
    kept = from_data(to_data(done.calibration))
    fresh = recorded(rng, 40, WALL)
    np.testing.assert_allclose(kept.predict(fresh), done.calibration.predict(fresh), atol=1e-12)
    miss = kept.predict(fresh)[:, :3, 3] - fresh.reading
    assert 1e3 * float(np.sqrt(np.mean(np.sum(miss**2, axis=1)))) < 1.25 * np.sqrt(3.0) * 0.02


def joined(*parts: Samples) -> tuple[Samples, tuple[float, ...]]:
    """Recordings one after the other, and the stamps between them."""
    until, samples = [], parts[0]
    for part in parts[1:]:
        late = float(samples.stamps.max() - part.stamps.min()) + 60.0
        told = tuple(replace(track, stamps=track.stamps + late) for track in part.signals)
        later = replace(part, stamps=part.stamps + late, signals=told)
        until.append(float(samples.stamps.max()) + 30.0)
        samples = samples.followed_by(later)
    return samples, tuple(until)


@pytest.mark.slow
def test_each_recording_has_its_payload_and_a_joint_one_compliance(rng: np.random.Generator) -> None:
    samples, until = joined(*(recorded(rng, 60, carried=kg) for kg in (0.0, 6.0, 3.0)))
    done = calibrated(samples, Cell(between=until))
    loads = done.report.loads
    assert loads is not None
    assert loads.down is None
    assert [p.mass for p in loads.payloads] == pytest.approx([0.0, 6.0, 3.0], abs=0.15)
    for found, kg in zip(loads.payloads, (0.0, 6.0, 3.0), strict=True):
        assert abs(found.mass - kg) < 4.0 * found.mass_std
    assert loads.payloads[1].place == pytest.approx(CENTRE, abs=0.02)
    sizes = {e.place: e.parameters for e in done.report.effects if e.family == "compliance"}
    for joint in ("shoulder_lift_joint", "elbow_joint", "wrist_1_joint"):
        expected = COMPLIANCE[CHAIN.names.index(joint)]
        assert sizes[joint]["compliance"][0] == pytest.approx(expected, rel=0.05)
    (carried,) = (e for e in done.report.effects if e.family == "payload")
    assert carried.place == "tool"
    assert carried.parameters["mass_2"][0] == pytest.approx(6.0, abs=0.15)
    assert left(done) < 1.25 * np.sqrt(3.0) * 0.02
    kept = from_data(to_data(done.calibration))
    np.testing.assert_allclose(kept.predict(samples), done.calibration.predict(samples), atol=1e-12)


def test_a_stated_way_of_weight_is_kept(rng: np.random.Generator) -> None:
    done = calibrated(recorded(rng, 90, WALL), Cell(gravity=tuple(9.81 * WALL)))
    assert done.report.loads is None
    assert left(done) < 1.25 * np.sqrt(3.0) * 0.02


@pytest.mark.slow
def test_stated_payloads_are_loads(rng: np.random.Generator) -> None:
    samples, until = joined(*(recorded(rng, 60, carried=kg) for kg in (0.0, 6.0)))
    place = (0.0, 0.02, 0.06)
    cell = Cell(between=until, payloads=(StatedPayload(0.0), StatedPayload(6.0, place)))
    done = calibrated(samples, cell)
    assert done.report.loads is None
    assert {e.place for e in done.report.effects} == {"shoulder_lift_joint", "elbow_joint", "wrist_1_joint"}
    for effect in done.report.effects:
        expected = COMPLIANCE[CHAIN.names.index(effect.place)]
        assert effect.parameters["compliance"][0] == pytest.approx(expected, rel=0.03)
    assert left(done) < 1.25 * np.sqrt(3.0) * 0.02
    with pytest.raises(BadTable, match="payloads: 3 are stated, and recordings: 2"):
        calibrated(samples, replace(cell, payloads=(StatedPayload(1.0),) * 3))


@pytest.mark.slow
def test_without_masses_recordings_share_a_compliance_per_kg(rng: np.random.Generator) -> None:
    """Loads at the tip alone, in the second recording 2.5 times those of the first: nothing tells the kilograms."""
    samples, until = joined(*(recorded_at_tip(rng, 70, kg) for kg in (2.0, 5.0)))
    done = calibrate(samples, CHAIN, np.random.default_rng(0), Cell(between=until))
    loads = done.report.loads
    assert loads is not None
    assert loads.relative
    assert [p.mass for p in loads.payloads] == pytest.approx([0.4, 1.0], abs=0.03)
    sizes = {e.place: e.parameters for e in done.report.effects}
    assert sizes["elbow_joint"]["compliance_times_mass"][0] == pytest.approx(5.0 * COMPLIANCE[2], rel=0.05)
    assert "stiffness" not in sizes["elbow_joint"]
    assert any("per kg" in note for note in done.report.notes)
    assert left(done) < 1.25 * np.sqrt(3.0) * 0.02


def recorded_at_tip(rng: np.random.Generator, count: int, kg: float, own: bool = False) -> Samples:
    """A load at the tip, of an arm that weighs nothing itself, or what it weighs."""
    q = rng.uniform(-1.6, 1.6, (count, 6))
    pulled = torques(q, DOWN, kg, np.zeros(3)) - (not own) * torques(q, DOWN, 0.0, np.zeros(3))
    T = BASE @ chain_forward(CHAIN, q + COMPLIANCE * pulled) @ TOOL
    T[:, :3, 3] += 2e-5 * rng.standard_normal((count, 3))
    return samples_of(CHAIN, q, T)


@pytest.mark.slow
def test_a_topic_that_says_what_is_carried_is_the_load(rng: np.random.Generator) -> None:
    """Nothing is found in its place, so that another recording is predicted by its own topic."""
    masses = (0.0, 6.0)
    parts = [_telling(recorded_at_tip(rng, 60, kg, own=True), kg) for kg in masses]
    samples, until = joined(*parts)
    done = calibrated(samples, Cell(between=until))
    assert done.report.loads is None
    other = _telling(recorded_at_tip(rng, 40, 3.0, own=True), 3.0)
    miss = done.calibration.predict(other)[:, :3, 3] - other.reading
    assert 1e3 * float(np.sqrt(np.mean(np.sum(miss**2, axis=1)))) < 1.4 * np.sqrt(3.0) * 0.02


@pytest.mark.slow
@pytest.mark.parametrize("turning", [2e-5, 0.0])
def test_what_a_topic_says_is_carried_has_one_centre_for_all_joints(rng: np.random.Generator, turning: float) -> None:
    """It shows in what geometry leaves; beside orientations that are exact only once joints are known to be elastic."""
    samples, until = joined(*(_telling(recorded(rng, 50, carried=kg), kg) for kg in (0.0, 6.0)))
    samples = replace(samples, R=samples.R @ so3.exp(turning * rng.standard_normal((len(samples), 3))))
    done = calibrated(samples, Cell(between=until))
    loads = done.report.loads
    assert loads is not None
    assert not loads.payloads
    assert loads.centre is not None
    assert loads.centre_std is not None
    assert (np.abs(loads.centre - CENTRE) < 4.0 * loads.centre_std).all()
    # orientations that are exact count as those of the best instrument, and tell the centre less well
    assert loads.centre == pytest.approx(CENTRE, abs=0.02 if turning else 0.04)
    sizes = {e.place: e.parameters for e in done.report.effects}
    assert len(sizes) == len(done.report.effects)  # each joint once
    for joint in ("shoulder_lift_joint", "elbow_joint", "wrist_1_joint"):
        assert sizes[joint]["compliance"][0] == pytest.approx(COMPLIANCE[CHAIN.names.index(joint)], rel=0.05)
    assert any("The payload that the recording states has its centre at" in note for note in done.report.notes)
    said = to_json_data(done.report)["loads"]
    assert said["stated_payload_centre_m"] == pytest.approx(loads.centre)
    kept = from_data(to_data(done.calibration))
    other = _telling(recorded(rng, 40, carried=3.0), 3.0)
    np.testing.assert_allclose(kept.predict(other), done.calibration.predict(other), atol=1e-12)
    miss = kept.predict(other)[:, :3, 3] - other.reading
    assert 1e3 * float(np.sqrt(np.mean(np.sum(miss**2, axis=1)))) < 1.25 * np.sqrt(3.0) * 0.02


def _telling(samples: Samples, kg: float) -> Samples:
    """The samples with a topic of what is carried."""
    told = SignalTrack("signal:/payload_kg", samples.stamps, np.full((len(samples), 1), kg), "/payload_kg")
    return replace(samples, signals=(told,))


def test_a_compliance_in_many_samples_comes_without_a_payload() -> None:
    """Of more samples than choices are weighed against each other for, too."""
    done = calibrated(recorded(np.random.default_rng(1), 600))
    assert {(e.family, e.place) for e in done.report.effects} == {
        ("compliance", joint) for joint in ("shoulder_lift_joint", "elbow_joint", "wrist_1_joint")
    }
    assert done.report.loads is None
    assert left(done) < 1.05 * np.sqrt(3.0) * 0.02
