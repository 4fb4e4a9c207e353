"""Pairs of explanations that one recording leaves open: how many are separated by at most twelve more stations."""

from __future__ import annotations

import json

import numpy as np
from cells import Bench

from modcal_core.measuring.choose import deciding_stations, one_motion
from modcal_core.measuring.refit import Refit, refit
from modcal_core.measuring.session import Session, Station

FAULTS = (
    "compliance", "bearing_tilt", "gear_ratio", "axis_wobble", "encoder_eccentricity", "wrist_coupling",
    "hardening_spring",
)  # fmt: skip
ARMS = ("ur10", "panda", "xarm7")
RECORDED, NARROW = 45, 0.45  # stations of the recording, and the share of each joint's range that it covers
MAX, AT_ONCE = 12, 4


def ties(count: int) -> None:
    """Go through cells until so many pairs were left open, and separate them."""
    found = separated = one = 0
    seed = 0
    while found < count and seed < 40 * count:
        robot, fault = ARMS[seed % 3], FAULTS[(seed // 3) % len(FAULTS)]
        seed += 1
        bench = Bench(robot, fault, 500 + seed, "point" if seed % 2 else "pose")
        session = recorded(bench)
        model = fitted(bench, session)
        before = open_pairs(model)
        stations, between = deciding_stations(model, bench.pool, AT_ONCE, np.random.default_rng(seed))
        if not stations:
            continue
        found += 1
        used = 0
        while stations and used < MAX:
            stations = stations[: MAX - used]
            session = session.asking(stations)
            for number in session.pending:
                session = session.with_station(number, bench.measure(session.stations[number]))
            used += len(stations)
            model = fitted(bench, session)
            stations, _ = deciding_stations(model, bench.pool, AT_ONCE, np.random.default_rng(seed + used))
        name, _, other = between.partition(" or ")
        decided = (name, other) not in open_pairs(model) and (other, name) not in open_pairs(model)
        separated += decided
        # a curve that was taken for an effect can be told from its rival, and the line that is left cannot
        same = not decided and (name, other) in one_motion(model, bench.pool, np.random.default_rng(seed))
        one += same
        print(
            json.dumps(
                {
                    "cell": f"{robot} {fault} {500 + seed}", "between": between, "more": used, "decided": decided,
                    "one_motion": same,
                    "open_before": len(before), "open_after": len(open_pairs(model)),
                    "effects": [e.label for e in model.calibration.calibrated.effects],
                    "true": [list(f.place) for f in bench.faults],
                }
            ),
            flush=True,
        )  # fmt: skip
    print(
        f"ties: of {found} pairs that {RECORDED} stations left open, {separated} were separated by at most {MAX} "
        f"more; {one} turned out to be one motion, which is said"
    )


def recorded(bench: Bench) -> Session:
    """Random stations of a part of the joints' ranges."""
    bench.begin(0)
    rng = np.random.default_rng([bench.seed, 30])
    low, high = bench.cell.arm.range
    middle = 0.5 * (low + high) + 0.25 * rng.uniform(-1.0, 1.0, len(low)) * (high - low)
    half = 0.5 * NARROW * (high - low)
    q = np.clip(rng.uniform(middle - half, middle + half, (RECORDED, len(low))), low, high)
    session = Session(bench.chain.names, bench.kind).asking([Station(row) for row in q])
    for number in session.pending:
        session = session.with_station(number, bench.measure(session.stations[number]))
    return session


def fitted(bench: Bench, session: Session) -> Refit:
    """The model from everything measured."""
    return refit(session.samples(session.fitted), bench.chain, 0, None, bench.inertias)


def open_pairs(model: Refit) -> set[tuple[str, str]]:
    """Pairs of explanations that the readings leave open, by name."""
    c = model.calibration
    pairs = zip(c.calibrated.effects, c.rivals, strict=False)
    return {(effect.label, rival.label) for effect, rivals in pairs for rival in rivals}
