"""Parts of a report: what no arm has is not used, notes on loads and descriptions, charts, and joint offsets."""

from __future__ import annotations

import re
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from cells import record, samples_of, ur10
from matplotlib.ticker import MaxNLocator
from scipy.stats import chi2

from modcal_core.calibration.model import Model, place_model
from modcal_core.diagnosis.loads import FoundPayload, Loads
from modcal_core.effects.drivers import NominalArm
from modcal_core.evaluation import evaluate
from modcal_core.geometry import se3, so3
from modcal_core.loop import calibrate
from modcal_core.measurements.samples import Samples
from modcal_core.outcome.entries import load_findings, load_notes
from modcal_core.outcome.joint_offsets import joint_offsets
from modcal_core.report.blocks import TableBlock
from modcal_core.report.charts import AFTER, BAD, Axis, Chart, Panel, round_numbers
from modcal_core.report.report import loads_to_json
from modcal_core.robots.urdf_inertias import Inertias
from modcal_core.verdict.contradicted import long_tool, sane_inertias
from modcal_nodes.simulation.mjcf import World

CHAIN = ur10()
SANE = Inertias(np.full(6, 3.0), np.tile([0.1, 0.0, 0.1], (6, 1)), np.zeros((6, 3, 3)))


@pytest.mark.parametrize(
    ("mass", "com", "said"),
    [
        (3.0, [500.0, 0.0, 0.0], "centre of mass 500 m away"),
        (1e6, [0.1, 0.0, 0.0], "a mass of 1e\\+06 kg"),
        (-1.0, [0.1, 0.0, 0.0], "a mass of -1 kg"),
        (np.nan, [0.1, 0.0, 0.0], "a mass of nan kg"),
    ],
)
def test_absurd_masses_are_named_and_not_used(mass: float, com: list[float], said: str) -> None:
    masses, centres = SANE.mass.copy(), SANE.com.copy()
    masses[2], centres[2] = mass, com
    used, sentences = sane_inertias(replace(SANE, mass=masses, com=centres), CHAIN)
    assert used is None
    (sentence,) = sentences
    assert re.search(f"behind elbow_joint .*{said}", sentence), sentence


def test_sane_ones_are_used() -> None:
    assert sane_inertias(SANE, CHAIN) == (SANE, ())
    assert sane_inertias(None, CHAIN) == (None, ())


@pytest.mark.slow
def test_a_calibration_says_so() -> None:
    centres = SANE.com.copy()
    centres[1] = [0.0, 500.0, 0.0]
    result = calibrate(
        record(1, 80).samples, CHAIN, np.random.default_rng(0),
        inertias=replace(SANE, com=centres), look_for_effects=False,
    )  # fmt: skip
    assert any("centre of mass 500 m" in said for said in result.report.grounds.contradictions)
    assert result.calibration.calibrated.arm is not None
    assert not result.calibration.calibrated.arm.weighed


def test_a_tool_longer_than_the_arm_is_named() -> None:
    model = place_model(CHAIN, ("tracker",))
    assert long_tool(model) == ()
    (said,) = long_tool(replace(model, T_tip_tool=se3.transform(p=[0.0, 3.0, 0.0])))
    assert "3.00 m from tool0" in said


@pytest.mark.parametrize("longer_m", [0.0, 0.08])
def test_a_link_of_another_length_is_said_though_it_is_fitted(longer_m: float) -> None:
    made = record(3, 70)
    origins = ur10().origins.copy()
    origins[2, :3, 3] *= 1.0 + longer_m / np.linalg.norm(origins[2, :3, 3])
    report = calibrate(
        made.samples, ur10().with_origins(origins), np.random.default_rng(0), look_for_effects=False
    ).report
    said = [note for note in report.notes if note.startswith("The nominal model misses by")]
    assert len(said) == (longer_m > 0.0)
    final = report.errors["final"].size_mm()
    assert final is not None
    assert final.rms < 0.5


ARM = NominalArm(ur10())


def test_that_gravity_cannot_be_told_is_said_with_what_would() -> None:
    unknown = Loads(ARM, ARM, unknown=True)
    (note,) = load_notes(unknown)
    assert "cannot tell gravity" in note
    assert note.endswith("State gravity: in the cell file.")
    said = loads_to_json(unknown)
    assert said is not None
    assert said["gravity_unknown"] is True
    assert said["gravity"] is None
    assert said["payloads"] == []


def test_a_way_that_was_found_is_told_and_no_doubt_of_it() -> None:
    down = np.array([0.6, 0.0, -0.8])
    found = Loads(ARM, ARM, down=down, down_std=0.01, turned=float(np.arccos(0.8)))
    (note,) = load_notes(found)
    assert "[+0.600, +0.000, -0.800]" in note
    assert "± 1.1°" in note
    assert "36.9° from where the robot description says" in note
    said = loads_to_json(found)
    assert said is not None
    assert said["gravity_unknown"] is False


def test_masses_in_units_of_another_are_no_kilograms() -> None:
    payloads = (FoundPayload(0.0, 0.4, 0.01), FoundPayload(10.0, 1.0, 0.0))
    relative = Loads(ARM, ARM, payloads=payloads, relative=True)
    (note,) = load_notes(relative)
    assert "0.40 ± 0.02 of what the tip carries in the last one" in note
    model = Model(ur10(), ("tracker",), np.eye(4)[None], se3.exp([0.05, 0, 0.1, 0, 0.3, 0]))
    assert load_findings(relative, model, record(11, 20).samples) == ()
    (note,) = load_notes(replace(relative, relative=False))
    assert "carries 0.40 ± 0.02 kg, 1.00 ± 0 kg in the recordings, one after the other" in note


def test_nothing_is_said_of_nothing() -> None:
    assert load_notes(None) == ()
    assert loads_to_json(None) is None


def test_a_row_is_written_from_a_record_and_none_as_nothing() -> None:
    record = {"name": "gear | x_1", "size": None, "ends": (0.1, 0.25), "of": "position:j_1"}
    table = TableBlock.of(
        "", "a | b | c | d", "{name} | {size[rms]:.1f} | {ends:.2f} | {of:driver}, {of:words}", [record]
    )
    assert table.header == ("a", "b", "c", "d")
    assert table.rows == (("gear | x_1", "", "0.10 … 0.25", "position of j_1, position:j 1"),)
    with pytest.raises(KeyError):
        TableBlock.of("", "a", "{nmae}", [record])


def test_ticks_stand_where_those_of_other_charts_do() -> None:
    rng = np.random.default_rng(0)
    usual = MaxNLocator(nbins=4, steps=[1, 2, 2.5, 5, 10])
    for _ in range(500):
        low = rng.normal() * 10.0 ** rng.uniform(-3, 3)
        high = low + 10.0 ** rng.uniform(-3, 4)
        ticks, _ = round_numbers(low, high)
        known = usual.tick_values(low, high)
        np.testing.assert_allclose(ticks, known[(known >= low) & (known <= high)], atol=1e-9 * (high - low))
        assert 2 <= len(ticks) <= 5


def test_points_and_ticks_share_a_scale() -> None:
    panel = Panel(Axis("joint <1>, rad", -2.0, 2.0), Axis("residual, mm", -1.0, 1.0))
    panel.marks(np.array([-1.0, 1.0]), np.array([0.5, -0.5]), AFTER, "dot", 2.2)
    panel.marks(np.array([0.0]), np.array([0.5]), BAD, "square")
    drawn = panel.chart("one", "Two points.", "against it").drawn
    texts = {t.text: t for t in ElementTree.fromstring(drawn).iter("text")}
    assert {"joint <1>, rad", "residual, mm", "−1", "1"} <= set(texts)
    (places,) = re.findall(r'<path d="M([\d. ]+)" fill="none" marker-start="url\(#one-mark0\)"', drawn)
    dots = np.array(places.split(), float).reshape(-1, 2).tolist()
    # beside the tick of the same number: its text stands in the middle below, or 2.85 points below its line
    where = [float(texts[k].get("x", "")) for k in ("−1", "1")]
    np.testing.assert_allclose([a for a, _ in dots], where, atol=0.06)  # they are written to a tenth
    assert abs(dots[0][1] + 2.85 - float(texts["0.5"].get("y", ""))) < 0.06
    assert abs(dots[1][1] + 2.85 - float(texts["−0.5"].get("y", ""))) < 0.06


@pytest.mark.parametrize(
    "ends", [(0.003, 0.02), (0.01, 0.02), (0.5, 0.7), (1.01, 1.09), (0.0112, 0.0119), (1e-5, 10.0)]
)
def test_a_logarithmic_axis_has_at_least_two_numbers(ends: tuple[float, float]) -> None:
    axis = Axis("force, N", *ends, log=True)
    ticks = [value for value, _ in axis.ticks()]
    assert 2 <= len(ticks) <= 9
    assert all(ends[0] * (1.0 - 1e-9) <= t <= ends[1] * (1.0 + 1e-9) for t in ticks)
    assert len({said for _, said in axis.ticks()}) == len(ticks)
    raised = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")
    said = [f"1e{s[2:].translate(raised)}" if set(s) & set("⁰¹²³⁴⁵⁶⁷⁸⁹") else s for _, s in axis.ticks()]
    np.testing.assert_allclose([float(one) for one in said], ticks, rtol=1e-5)


def _logarithmic() -> Chart:
    panel = Panel(Axis("force <1>, N", 0.008, 12.0, log=True), Axis("error, mm", 8e-5, 120.0, log=True))
    panel.marks(np.array([0.02, 0.3, 4.0]), np.array([1e-3, 1e-1, 10.0]), AFTER, "dot", 3.0)
    return panel.chart("one", "Three points.", "three points")


def test_on_logarithmic_axes_points_stand_where_the_numbers_say() -> None:
    drawn = _logarithmic().drawn
    texts = {t.text: (float(t.get("x", "")), float(t.get("y", ""))) for t in ElementTree.fromstring(drawn).iter("text")}
    assert {"force <1>, N", "error, mm", "0.01", "0.1", "1", "10", "10⁻⁴", "10⁰", "10²"} <= set(texts)
    (places,) = re.findall(r'<path d="M([\d. ]+)" fill="none" marker-start="url\(#one-mark0\)"', drawn)
    dots = np.array(places.split(), float).reshape(-1, 2)
    across = np.interp(np.log10([0.02, 0.3, 4.0]), [-2.0, 1.0], [texts["0.01"][0], texts["10"][0]])
    along = np.interp([-3.0, -1.0, 1.0], [-4.0, 2.0], [texts["10⁻⁴"][1] - 2.85, texts["10²"][1] - 2.85])
    np.testing.assert_allclose(dots, np.c_[across, along], atol=0.06)


OFFSETS = np.radians([0.3, -0.2, 0.15, 0.1, -0.05, 0.4])


@pytest.mark.parametrize("kind", ["pose", "point"])
def test_offsets_that_were_put_in_are_found(kind: str) -> None:
    """The first and the last joint's are turns of base and tool, and a point of the tool shows no turn of it."""
    chain = ur10()
    turned = se3.transform(so3.exp(np.c_[np.zeros((6, 2)), OFFSETS]))
    origins = np.array(chain.origins)
    origins[:-1] = origins[:-1] @ turned
    start = place_model(chain, ("tracker",))
    T_tip_tool = se3.exp([0.05, 0.03, 0.12, 0.4, -0.3, 0.2])
    base = se3.exp([1.0, -2.0, 0.3, 0.5, 0.1, -1.0])[None]
    model = replace(start, chain=chain.with_origins(origins), T_tip_tool=T_tip_tool, T_frame_base=base)
    q = np.random.default_rng(1).uniform(-2.5, 2.5, (60, 6))
    found = joint_offsets(model, q, kind == "pose")
    assert found is not None
    assert [o.joint for o in found.found] == list(chain.names[1:5])
    assert [o.value for o in found.found] == pytest.approx(OFFSETS[1:5], abs=4e-5)
    assert all(o.turning and o.std is None for o in found.found)
    assert found.left_mm < 0.01 * found.nominal_mm


def test_an_arm_that_is_nominal_has_none() -> None:
    model = place_model(ur10(), ("tracker",))
    q = np.random.default_rng(1).uniform(-2.5, 2.5, (20, 6))
    found = joint_offsets(model, q, True)
    assert found is not None
    assert [o.value for o in found.found] == pytest.approx([0.0] * 4, abs=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["pose", "point"])
def test_intervals_hold_what_they_say(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Recordings of one arm in MuJoCo that differ by postures and noise; the truth is that of thousands of postures."""
    chain, count, runs = ur10(), 60, 8
    frame, tool = se3.exp([1.0, 0.2, 0.1, 0.3, 0.2, -1.0]), se3.exp([0.05, 0.03, 0.12, 0, 0, 0])
    world = World(chain, np.random.default_rng(7), 5e-4, 1e-3, frame, tool)
    moved = np.random.default_rng(7).standard_normal((7, 6)) * ([5e-4] * 3 + [1e-3] * 3)
    start = place_model(chain, ("tracker",))
    true = replace(start, chain=chain.with_origins(chain.origins @ se3.exp(moved)), T_tip_tool=tool)
    rng = np.random.default_rng(8)

    def recording(n: int) -> Samples:
        q = rng.uniform(-2.5, 2.5, (n, 6))
        T = world.tool_in_tracker(q)
        T[:, :3, 3] += 3e-4 * rng.standard_normal((n, 3))
        T[:, :3, :3] = T[:, :3, :3] @ so3.exp(3e-4 * rng.standard_normal((n, 3)))
        return samples_of(chain, q, T, kind)

    drawn = []
    for _ in range(runs):
        made = calibrate(recording(count), chain, np.random.default_rng(0), look_for_effects=False)
        assert made.report.offsets is not None
        drawn.append(made.report.offsets.found)
    monkeypatch.setattr("modcal_core.outcome.joint_offsets._MAX", 4000)
    whole = joint_offsets(true, rng.uniform(-2.5, 2.5, (4000, 6)), kind == "pose")
    assert whole is not None
    z = [(o.value - t.value) / (o.std or np.nan) for run in drawn for o, t in zip(run, whole.found, strict=True)]
    assert len(z) == runs * 4
    # the four of a run may hang together as one would: then their squares add up to 4 times a chi square of so many
    low, high = 4.0 * chi2.ppf([0.001, 0.999], runs)
    assert low < np.sum(np.square(z)) < high
    # and a few postures are no better than they are: the interval is that of a recording, not of the noise alone
    assert np.std([o[0].value for o in drawn]) == pytest.approx(np.mean([o[0].std for o in drawn]), rel=1.0)


@pytest.mark.slow
def test_an_evaluation_has_the_offsets_of_its_calibration() -> None:
    made = record(4, 60, "point")
    found = calibrate(made.samples, ur10(), np.random.default_rng(0), look_for_effects=False)
    other = evaluate(found.calibration, record(9, 40, "point").samples, np.random.default_rng(0), refit_base=True)
    assert other.offsets == found.report.offsets is not None
