"""What many planned stations would have given: the best that a refusal can be compared with."""

from __future__ import annotations

import numpy as np
from cells import Bench

from modcal_core.measuring.choose import fit_stations
from modcal_core.measuring.outlook import outlook
from modcal_core.measuring.refit import refit
from modcal_core.measuring.session import Session, Station

_FIRST = 40  # stations, after which the model is good enough to choose the others by


def best_error(bench: Bench, count: int) -> float:
    """RMS error [m] of the model from so many stations, chosen for the error of the tool."""
    bench.begin(1)
    session = Session(bench.chain.names, bench.kind)
    pool = bench.pool
    session = measured(bench, session.asking([Station(pool.q[int(j)]) for j in pool.first(_FIRST)]))
    model = refit(session.samples(session.fitted), bench.chain, 0, None, bench.inertias)
    view = outlook(model, pool.where, model.spread, np.random.default_rng(0))
    more = fit_stations(pool, session, view, model, count - _FIRST, True, np.random.default_rng(0), 0)
    session = measured(bench, session.asking(more.stations))
    model = refit(session.samples(session.fitted), bench.chain, 0, None, bench.inertias)
    return bench.error(model.calibration)


def measured(bench: Bench, session: Session) -> Session:
    """The session with its pending stations done."""
    for number in session.pending:
        session = session.with_station(number, bench.measure(session.stations[number]))
    return session
