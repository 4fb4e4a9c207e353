"""modcal through its Python interface, as docs/howto/python.md shows it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from league.arm import Array
from league.task import Answer, Task

PERIOD = 10.0  # s between rows whose times nobody wrote down


def answer(task: Task) -> Answer:
    """With effects."""
    return _answer(task, geometry_only=False)


def geometry(task: Task) -> Answer:
    """Without them."""
    return _answer(task, geometry_only=True)


def _answer(task: Task, geometry_only: bool) -> Answer:
    import modcal

    robot = modcal.Robot.from_urdf(task.urdf, tip=task.tip)
    cell = None
    if task.kind == "socket":
        samples, cell = _sockets(task, robot)
    else:
        what = {"points": task.position} if task.kind == "point" else {"poses": task.reading}
        samples = modcal.Samples.from_arrays(task.q[task.train], names=task.arm.names, **what)
    # blocks that are held out whole where neighbours are alike; otherwise modcal decides
    block = task.block if task.block > 1 and len(task.train) > 10 * task.block else None
    result = modcal.calibrate(robot, samples, cell=cell, geometry_only=geometry_only, block=block)
    report, claim = result.report, result.claim
    return Answer(
        _predicted(task, result.calibration),
        claim_p95=None if claim is None else 1e-3 * claim.mm["p95"].ci95[1],
        is_open=report.status == "open",
        named=tuple((str(f.family), str(f.place)) for f in report.effects),
        parameters=len(report.parameters),
        remark="; ".join((report.status, *report.open_because[:2])),
    )


def _predicted(task: Task, calibration) -> Array:  # type: ignore[no-untyped-def]
    """Poses at every row, which are told where each joint came from."""
    import modcal

    both = np.stack([task.before, task.q], axis=1).reshape(-1, task.q.shape[1])
    rows = modcal.Samples.from_arrays(both, points=np.zeros((len(both), 3)), names=task.arm.names)
    frame = calibration.frames[0]
    rows = replace(rows.select(slice(1, None, 2)), frames=(frame,))
    T = calibration.predict(rows, frame)
    return np.linalg.inv(calibration.T_frame_base[frame]) @ T if task.kind == "socket" else np.asarray(T)


def _sockets(task: Task, robot):  # type: ignore[no-untyped-def]
    """Samples and cell of a ball that rests in sockets."""
    import modcal
    from modcal_core.measurements import ORDER_ONLY, JointTrack, ReadingTrack, Recording
    from modcal_core.preprocess import prepare

    q, frame = task.q[task.train], task.frame[task.train]
    t = 1.7e9 + PERIOD * np.arange(len(q))
    unknown = np.full_like(q, np.nan)
    names = {f: f"socket_{f}" for f in np.unique(frame)}
    tracks = tuple(
        ReadingTrack("point", names[f], t[frame == f], np.zeros(((frame == f).sum(), 3)), t[frame == f]) for f in names
    )
    distances = tuple(modcal.Distance((names[a], names[b]), task.distance) for a, b in task.pairs)
    cell = modcal.Cell(distances=distances, sockets=tuple(names.values()))
    recording = Recording((JointTrack(task.arm.names, t, q, unknown, unknown, t),), tracks, warnings=(ORDER_ONLY,))
    return prepare(recording, robot.mechanism).samples, cell
