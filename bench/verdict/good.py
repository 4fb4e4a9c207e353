"""Good recordings: clean arms, and arms whose every fault has an entry in the vocabulary."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from case import Case, kind
from recordings import plant
from scenarios import SCENARIOS
from workcell import BEGIN, PERIOD, Session, SignalTrack, Works, from_


def good(session: Session, *options: str) -> Case:
    """A calibration of which nothing bad is to be said."""
    return Case({"bag": session}, (("calibrate", "{bag}", *options),), False)


def _clean(name: str, count: int, **options: Any) -> None:
    def maker(w: Works, rng: np.random.Generator) -> Case:
        return good(w.clean(count, **options))

    maker.__name__ = name
    kind("good")(maker)


_clean("clean_poses", 100)
_clean("clean_points", 150, kind="point")
_clean("clean_few", 50)
_clean("clean_many", 600)
_clean("clean_many_points", 400, kind="point")
_clean("clean_coarse_instrument", 120, noise_mm=0.2, noise_mrad=0.3)
_clean("clean_fine_instrument", 120, noise_mm=0.004, noise_mrad=0.005)
_clean("clean_arm_that_repeats_badly", 140, repeat=8e-5)
_clean("clean_position_only_coarse", 160, kind="point", noise_mm=0.15, repeat=3e-5)


@kind("good")
def clean_small_range(w: Works, rng: np.random.Generator) -> Case:
    """A third of each joint's range."""
    return good(w.observe(*w.postures(120, low=0.3, high=0.65)))


@kind("good")
def clean_dwells(w: Works, rng: np.random.Generator) -> Case:
    """Streams of joint states and readings, with dwells."""
    session = w.observe(*w.postures(100), noise_mm=0.0, noise_mrad=0.0)
    arm_mm, arm_deg, _, _ = session.stated
    eye_mm, eye_deg = 0.02 * np.sqrt(3.0), np.degrees(2e-5 * np.sqrt(3.0))
    floor = float(np.hypot(arm_mm, eye_mm / np.sqrt(15)))
    return good(replace(session, stream=10.0, stated=(arm_mm, arm_deg, eye_mm, eye_deg), floor_mm=floor))


@kind("good")
def clean_few_wrong_readings(w: Works, rng: np.random.Generator) -> Case:
    """Three of 150 readings are off by centimetres, not neighbours."""
    session = w.clean(150)
    rows = rng.choice(np.flatnonzero(~session.again)[::3], 3, replace=False)
    p = session.p.copy()
    p[rows] += rng.normal(0, 0.01, (3, 3))
    return good(replace(session, p=p))


@kind("good")
def clean_read_five_times(w: Works, rng: np.random.Generator) -> Case:
    """Every stop is read five times in sequence, by an instrument that is far finer than the arm repeats."""
    return good(_five_times(w.clean(70, noise_mm=0.004, noise_mrad=0.005), rng))


@kind("good")
def gear_read_five_times(w: Works, rng: np.random.Generator) -> Case:
    """The same of an arm with a gear that errs."""
    (fault,) = plant(w.cell, SCENARIOS["gear_harmonic"], rng, 120 * PERIOD)
    return good(_five_times(w.clean(120, fault.bend, noise_mm=0.004, noise_mrad=0.005), rng))


def _five_times(session: Session, rng: np.random.Generator) -> Session:
    """Each row five times, a fifth of a period apart, with more scatter of the instrument."""
    often = session.only(np.repeat(np.arange(len(session)), 5))
    later = np.tile(0.1 * PERIOD * np.arange(5), len(session))
    return replace(often, t=often.t + later, p=often.p + rng.normal(0, 4e-6, often.p.shape))


def _planted(name: str, scenario: str, count: int = 160) -> None:
    def maker(w: Works, rng: np.random.Generator) -> Case:
        faults = plant(w.cell, SCENARIOS[scenario], rng, count * PERIOD)
        session = w.clean(count, *(fault.bend for fault in faults))
        signals = []
        for fault in faults:
            if fault.sensor is not None:
                link, temperature = fault.sensor
                clock = np.arange(0.0, count * PERIOD + 1.0)
                values = temperature(clock) + rng.normal(0, 0.05, len(clock))
                signals.append(SignalTrack(f"temperature:{link}", BEGIN + clock, values[:, None], "/temperature"))
        return good(replace(session, signals=tuple(signals)))

    maker.__name__ = name
    kind("good")(maker)


_planted("elastic_joints", "compliance_all")
_planted("elastic_bearing", "bearing_tilt")
_planted("gear", "gear_harmonic")
_planted("coupled_wrist", "wrist_coupling")
_planted("gear_ratio", "gear_ratio")
_planted("wobbling_axis", "axis_wobble")
_planted("backlash", "approach_backlash")
_planted("bumped_tool", "tool_bump")
_planted("settling_tripod", "tripod_settling")
_planted("warm_link_with_sensor", "thermal_sensor")
_planted("gear_and_springs", "gear_harmonic+compliance", 200)


@kind("good")
def frozen_again(w: Works, rng: np.random.Generator) -> Case:
    """A calibration that still holds."""
    first, second = w.clean(120), w.clean(70, begin=3600.0)
    return _evaluated(first, second)


@kind("good")
def frozen_with_the_base_found_again(w: Works, rng: np.random.Generator) -> Case:
    """A calibration that still holds, the tracker somewhere else."""
    second = w.clean(80, w.base(w.way(0.3), w.way(0.2), from_(0)), begin=3600.0)
    return _evaluated(w.clean(120), second, "--refit-base")


@kind("good")
def frozen_elastic(w: Works, rng: np.random.Generator) -> Case:
    """A calibration with springs that still holds."""
    elastic = w.elastic(4e-4)
    return _evaluated(w.clean(140, elastic), w.clean(70, elastic, begin=3600.0))


def _evaluated(first: Session, second: Session, *options: str) -> Case:
    steps = (("calibrate", "{first}"), ("evaluate", "{out0}", "{second}", *options))
    return Case({"first": first, "second": second}, steps, False)


@kind("good")
def also_another(w: Works, rng: np.random.Generator) -> Case:
    """Two recordings of one cell, fitted together."""
    steps = (("calibrate", "{first}", "--also", "{second}"),)
    return Case({"first": w.clean(70), "second": w.clean(60, begin=3600.0)}, steps, False)
