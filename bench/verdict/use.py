"""Calibrations used where they do not hold: another day, another tool, other postures, a signal that is missing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from case import Case, calibrated, frozen, kind
from physics import LOAD, tilted
from regimes import BASE
from workcell import BEGIN, PERIOD, Array, SignalTrack, Works, from_

DAY = 86_400.0


def gear(w: Works, i: int, size: float = 4e-4):  # type: ignore[no-untyped-def]
    """A gear that errs."""
    cycles = int(w.rng.integers(20, 90))
    return w.joint(i, lambda s: size * np.sin(cycles * s.q[:, i]))


@kind()
def drift_carried_on(w: Works, rng: np.random.Generator) -> Case:
    """A drift that was steady, evaluated three days after it ended, the base found again."""
    v = w.way(2e-3)
    first = w.clean(140, tilted(w, lambda s: np.outer(s.t / 560.0, v)))
    second = w.clean(70, begin=3 * DAY)
    return frozen(first, second, ("time", "drift", "outside"), "--refit-base", shown="if left")


@kind()
def tool_drift_carried_on(w: Works, rng: np.random.Generator) -> Case:
    """A tool that crept, evaluated a day later."""
    v = w.way(1e-3)

    def bend(arm, stations, deviation) -> None:  # type: ignore[no-untyped-def]
        deviation.tool[:, :3] += np.outer(np.minimum(stations.t, 560.0) / 560.0, v)

    first, second = w.clean(140, bend), w.clean(70, bend, begin=DAY)
    return frozen(first, second, ("time", "drift", "outside", r"\btool\b"), shown="if left")


@kind()
def order_taken_for_a_clock(w: Works, rng: np.random.Generator) -> Case:
    """Rows without stamps, numbered at a fixed period; a drift by order is carried to another table."""
    v = w.way(8e-4)
    turn = lambda s: np.outer((s.t - s.t[0]) / 560.0, v)  # noqa: E731
    first = w.clean(140, tilted(w, turn), period=10.0)
    second = w.clean(60, period=10.0)
    return frozen(first, second, ("order", "clock", "time", "drift"), "--refit-base", shown="if left")


@kind()
def tool_changed_frozen(w: Works, rng: np.random.Generator) -> Case:
    """Another tool, which is not found again."""
    return frozen(w.clean(120), w.clean(70, w.tool(w.way(0.003), w.way(0.34), from_(0))), (r"\btool\b",))


@kind()
def base_moved_frozen(w: Works, rng: np.random.Generator) -> Case:
    """Another place of the tracker, which is not found again."""
    return frozen(w.clean(120), w.clean(70, w.base(w.way(0.02), w.way(0.01), from_(0))), BASE)


@kind()
def base_moved_within_the_frozen(w: Works, rng: np.random.Generator) -> Case:
    """A frozen model on a recording in which the tracker is moved half way."""
    return frozen(w.clean(120), w.clean(90, w.base(w.way(0.02), w.way(0.01), from_(45))), BASE)


@kind()
def joint_adjusted_frozen(w: Works, rng: np.random.Generator) -> Case:
    """A joint has a new zero since the calibration."""
    i = w.any_joint(1, w.arm.n - 1)
    second = w.clean(80, w.joint(i, lambda s: np.full(len(s.t), 1.5e-3)))
    return frozen(w.clean(120), second, (w.names[i - 1], w.names[i], w.names[i + 1]))


@kind()
def payload_unknown_frozen(w: Works, rng: np.random.Generator) -> Case:
    """An elastic arm carries eight kilograms that it did not carry when calibrated."""
    elastic = w.elastic(4e-4)

    def payload(arm, stations, deviation) -> None:  # type: ignore[no-untyped-def]
        deviation.payload += 8.0

    return frozen(w.clean(140, elastic), w.clean(80, elastic, payload), (*LOAD, *w.names))


@kind()
def effort_missing(w: Works, rng: np.random.Generator) -> Case:
    """Springs found by measured effort, on a recording without any."""
    elastic = w.elastic(5e-4)
    second = w.clean(80, elastic)
    return frozen(w.clean(140, elastic, effort=True), second, ("effort", *LOAD, *w.names), shown="if left")


@kind()
def effort_missing_with_a_payload(w: Works, rng: np.random.Generator) -> Case:
    """The same with a payload that nothing but the effort shows."""
    elastic = w.elastic(5e-4, payload=5.0)
    first = w.clean(140, elastic, effort=True)
    return frozen(first, w.clean(80, elastic), ("effort", *LOAD, *w.names), shown="if left")


def _warm(w: Works, begin: float, seconds: float, low: float, high: float) -> tuple[Array, Array]:
    clock = np.arange(begin, begin + seconds, 2.0)
    phase = w.rng.uniform(0, 2 * np.pi)
    return clock, low + (high - low) * (0.5 - 0.5 * np.cos(2 * np.pi * clock / 310.0 + phase))


def _thermal(w: Works, count: int, begin: float, low: float, high: float):  # type: ignore[no-untyped-def]
    """A recording of an arm whose forearm grows with its temperature, and that temperature."""
    clock, warm = _warm(w, begin, count * PERIOD + 1.0, low, high)

    def bend(arm, stations, deviation) -> None:  # type: ignore[no-untyped-def]
        deviation.x[:, 2, 0] += 2e-5 * (np.interp(stations.t, clock, warm) - 20.0)

    session = w.clean(count, bend, begin=begin)
    seen = (warm + w.rng.normal(0, 0.05, len(warm)))[:, None]
    link = w.arm.parents[2]
    return session, SignalTrack(f"temperature:{link}", BEGIN + clock, seen, "/temperature")


@kind()
def temperature_missing(w: Works, rng: np.random.Generator) -> Case:
    """A link grows with a recorded temperature, on a recording without any."""
    first, track = _thermal(w, 140, 0.0, 20.0, 50.0)
    second, _ = _thermal(w, 80, 2000.0, 30.0, 70.0)
    return frozen(replace(first, signals=(track,)), second, ("temperature", "thermal"))


@kind()
def temperature_out_of_range(w: Works, rng: np.random.Generator) -> Case:
    """A link that grows with the square of its temperature, used much warmer than it was calibrated."""
    clock, warm = _warm(w, 0.0, 600.0, 20.0, 35.0)
    later, hot = _warm(w, 2000.0, 400.0, 60.0, 80.0)

    def grows(when: Array, what: Array):  # type: ignore[no-untyped-def]
        def bend(arm, stations, deviation) -> None:  # type: ignore[no-untyped-def]
            deviation.x[:, 2, 0] += 1e-6 * (np.interp(stations.t, when, what) - 20.0) ** 2

        return bend

    link = w.arm.parents[2]
    tracks = [
        SignalTrack(f"temperature:{link}", BEGIN + a, b[:, None], "/temperature")
        for a, b in ((clock, warm), (later, hot))
    ]
    first = replace(w.clean(140, grows(clock, warm)), signals=(tracks[0],))
    second = replace(w.clean(80, grows(later, hot), begin=2000.0), signals=(tracks[1],))
    return frozen(first, second, ("temperature", "thermal", "outside"), shown="if left")


def _ranges(w: Works, bend, must_name: tuple[str, ...]) -> Case:  # type: ignore[no-untyped-def]
    first = w.observe(*w.postures(160, low=0.0, high=0.6), bend)
    second = w.observe(*w.postures(80, low=0.55, high=1.0), bend, begin=5000.0)
    return frozen(first, second, must_name, shown="if left")


@kind()
def curve_out_of_range(w: Works, rng: np.random.Generator) -> Case:
    """A curve of a joint's error, used in a range that was not seen."""
    i = w.any_joint(0, 4)
    low, high = w.arm.range[:, i]

    def off(stations) -> Array:  # type: ignore[no-untyped-def]
        u = (stations.q[:, i] - low) / (high - low)
        return 1.5e-3 * u * np.sin(5.0 * u) * (1.0 + u)

    return _ranges(w, w.joint(i, off), (w.names[i], "outside", "range"))


@kind()
def geometry_out_of_range(w: Works, rng: np.random.Generator) -> Case:
    """An elastic arm, used in a range that was not seen."""
    return _ranges(w, w.elastic(8e-4), ("outside", "range", *LOAD, *w.names))


@kind()
def geometry_only(w: Works, rng: np.random.Generator) -> Case:
    """A gear that errs, and --geometry-only."""
    i = w.any_joint(0, 4)
    must_name = (w.names[i], "geometry-only", "geometry only", "not looked for")
    return calibrated(w.clean(150, gear(w, i)), must_name, "--geometry-only")


@kind()
def geometry_only_with_a_drift(w: Works, rng: np.random.Generator) -> Case:
    """A stand that turns steadily, and --geometry-only."""
    v = w.way(6e-4)
    session = w.clean(150, tilted(w, lambda s: np.outer(s.t / 600.0, v)))
    return calibrated(
        session, (*BASE, "time", "order", "geometry-only", "geometry only", "not looked for"), "--geometry-only"
    )


@kind()
def gear_seen_too_rarely(w: Works, rng: np.random.Generator) -> Case:
    """Two gears of many cycles at few stations: too much to be found, too large to be noise."""
    bends = gear(w, 0, 8e-4), gear(w, 1, 8e-4), gear(w, 2, 8e-4)
    return calibrated(w.clean(60, *bends, kind="point"), ())


@kind()
def worn_since(w: Works, rng: np.random.Generator) -> Case:
    """A gear that errs now and did not when the arm was calibrated."""
    i = w.any_joint(0, 4)
    return frozen(w.clean(120), w.clean(100, gear(w, i, 5e-4)), (w.names[i], "held-out", "floor", "repeat", "spread"))


@kind()
def nonsense_frozen(w: Works, rng: np.random.Generator) -> Case:
    """Readings of another arm."""
    second = w.clean(80)
    rows = rng.permutation(len(second))
    return frozen(w.clean(120), replace(second, p=second.p[rows], R=second.R[rows]))
