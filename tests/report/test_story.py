"""The story is that of the final model: sizes with units and conditions, gains by removal, chances."""

from __future__ import annotations

import numpy as np
import pytest
from cells import slider_arm, ur10
from diagnosis.test_diagnosis import CAUSES, recorded

from modcal_core.effects.effect import ACROSS, ALL, AXIS, Effect
from modcal_core.effects.family import ReportEntry
from modcal_core.effects.registry import family_named
from modcal_core.effects.shapes import Shape
from modcal_core.effects.sizes import rhythm
from modcal_core.loop import calibrate
from modcal_core.outcome.entries import parameters

CHAIN, SLIDER = ur10(), slider_arm()
X = np.linspace(-2.0, 2.0, 4096)


def test_a_rhythm_is_a_line_that_stands_out() -> None:
    rng = np.random.default_rng(0)
    curves = [
        Shape("spline", {"low": -2.0, "high": 2.0, "count": 83.0}).basis(X).T @ rng.normal(size=83) for _ in range(40)
    ]
    assert all(rhythm(X, curve) is None for curve in curves), "what wanders has no rhythm"
    for cycles in (11.0, 40.0, 101.0):
        for share in (0.0, 0.5):
            found = rhythm(X, np.sin(cycles * X + 1.0) + share * curves[0] / curves[0].std())
            assert found == pytest.approx(cycles, abs=0.5)
    assert rhythm(X, np.sin(101.0 * X), deviation=0.5) is None, "no larger than its own uncertainty"
    narrow = np.linspace(0.0, 0.5, 4096)
    assert rhythm(narrow, np.sin(20.0 * narrow)) is None, "fewer than three periods were seen"


def story(name: str, *entry: object) -> str:
    return family_named(name).sentence(ReportEntry(*entry))  # type: ignore[arg-type]


def sizes(chain: object, *effect: object, values: tuple[float, ...]) -> dict[str, tuple[float, float, str]]:
    made = Effect(*effect).with_values(np.array(values), np.full(len(values), 1e-9))  # type: ignore[arg-type]
    return parameters((made,), chain)  # type: ignore[arg-type]


def test_sizes_have_units_of_their_own() -> None:
    elbow = ("wrist_1_joint", AXIS, "position:elbow_joint", Shape("linear"))
    assert sizes(CHAIN, "coupling", *elbow, values=(1e-4,))["coupling"][2] == "rad/rad"
    for place, driver, unit in (("j0", "j1", "rad/m"), ("j1", "j0", "m/rad"), ("j1", "j4", "m/m")):
        found = sizes(SLIDER, "coupling", place, AXIS, f"position:{driver}", Shape("linear"), values=(1e-4,))
        assert found["coupling"][2] == unit
    ramp = sizes(CHAIN, "drift", "base", ALL, "time", Shape("ramp", {"since": 0.0}), values=(1e-6,) * 6)
    assert [q[2] for q in ramp.values()] == ["m/s"] * 3 + ["rad/s"] * 3
    tilt = sizes(CHAIN, "compliance", "elbow_joint", ACROSS, "moment:elbow_joint", Shape("linear"), values=(1e-5,))
    assert tilt["stiffness"][2] == "N m/rad"
    slide = sizes(SLIDER, "compliance", "j1", AXIS, "load:j1", Shape("linear"), values=(1e-5,))
    assert slide["stiffness"][2] == "N/m"
    signal = sizes(CHAIN, "unknown", "elbow_joint", AXIS, "signal:/pressure", Shape("linear"), values=(1e-5,))
    assert signal["axis"][2] == "rad/unit"


def test_a_stiffness_needs_a_mass() -> None:
    effect = ("elbow_joint", AXIS, "payload:elbow_joint", Shape("linear"))
    found = sizes(CHAIN, "compliance", *effect, values=(5e-6,))
    assert "stiffness" not in found
    said = story("compliance", "elbow_joint", AXIS, "load:elbow_joint", found)
    assert "5 µrad per N m that 1 kg at the tip exerts" in said
    assert "N m/rad" not in said
    stiff = sizes(CHAIN, "compliance", "elbow_joint", AXIS, "load:elbow_joint", Shape("linear"), values=(5e-6,))
    assert "stiffness 2e+05 N m/rad" in story("compliance", "elbow_joint", AXIS, "load:elbow_joint", stiff)


@pytest.mark.parametrize(
    ("driver", "amount"),
    [("load:elbow_joint", "against load by 5 µrad per N m;"), ("payload:elbow_joint", "5 µrad per N m that 1 kg at")],
)
def test_what_moves_against_its_load_is_no_spring(driver: str, amount: str) -> None:
    found = sizes(CHAIN, "compliance", "elbow_joint", AXIS, driver, Shape("linear"), values=(-5e-6,))
    assert "stiffness" not in found
    said = story("compliance", "elbow_joint", AXIS, driver, found)
    assert "elbow_joint deflects against load" in said
    assert amount in said
    assert "no spring does that" in said


def test_a_step_and_a_curve_say_how_large_they_are() -> None:
    step = sizes(CHAIN, "step", "tool", ALL, "time", Shape("step", {"at": 7.0}), values=(3e-3, 4e-3, 0, 0, 0, 0.1))
    assert "tool moved by 5 mm and 100 mrad at one moment (stamp 7.0 s)" in story("step", "tool", ALL, "time", step)
    rng = np.random.default_rng(1)
    curve = sizes(
        CHAIN, "gear_harmonic", "elbow_joint", AXIS, "position:elbow_joint",
        Shape("spline", {"low": -2.0, "high": 2.0, "count": 83.0}), values=tuple(1e-4 * rng.normal(size=83)),
    )  # fmt: skip
    rough = {name: (size, size, unit) for name, (size, _, unit) in curve.items()}  # deviations of single points
    said = story("gear_harmonic", "elbow_joint", AXIS, "position:elbow_joint", rough)
    assert said.endswith("a curve over the joint's position")
    assert "±" not in said
    assert "times a turn" not in said


def test_a_size_that_the_stations_do_not_determine_is_not_stated() -> None:
    at = ("wrist_2_joint", AXIS, "position:wrist_2_joint")
    loose = {"amplitude": (3.1e-3, 1.8e-3, "rad"), "cycles_per_turn": (11.9, 0.01, "1")}
    firm = {"amplitude_2": (2.5e-4, 1e-5, "rad"), "cycles_per_turn_2": (2.0, 0.0, "1")}
    twice = {"amplitude_twice_2": (4.0e-4, 6e-5, "rad")}
    said = story("gear_harmonic", *at, {**loose, **firm})
    assert "repeats 2 times a turn with 0.25 mrad; of one other these stations do not determine the size" in said
    assert "3.1" not in said
    said = story("gear_harmonic", *at, {**loose, **firm, **twice})
    assert "repeats 4 times a turn with 0.4 ± 0.06 mrad, with 1 more such lines; of one other" in said
    said = story("gear_harmonic", *at, loose)
    assert "11.9" not in said
    assert "mrad" not in said
    assert "do not determine the size of any line" in said


@pytest.mark.slow
def test_the_story_of_a_planted_cause() -> None:
    samples = recorded(4, CAUSES["gear, 101 a turn"][0], count=120)
    report = calibrate(samples, CHAIN, np.random.default_rng(0)).report
    (gear,) = report.effects
    geometric, final = report.size_mm("geometric"), report.size_mm("final")
    assert geometric is not None
    assert final is not None
    # the only effect: without it there is geometry alone, which is fitted once more in closed form
    assert 1e3 * gear.before == pytest.approx(geometric.rms, rel=0.1)
    assert 1e3 * gear.after == pytest.approx(final.rms, rel=1e-9)
    assert gear.ci95 is not None
    assert gear.ci95[0] < gear.gain_mm2 < gear.ci95[1]  # type: ignore[operator]
    assert gear.shown
    assert "; without it the error would be" in gear.sentence
    assert "it moves the tool by" in gear.sentence
    assert gear.chance == "below 1e-06"
