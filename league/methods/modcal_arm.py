"""modcal through its Python interface, as docs/howto/python.md shows it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from league.arm import Array
from league.task import Answer, Task

PERIOD = 10.0  # s between rows whose times nobody wrote down
RULER = 1e-4  # m, to which the board was measured
PX = 0.1  # of a corner, as a detector says
P95 = 1.614  # of the 95th percentile to the RMS of errors that are alike in three directions
REACH, POINTS = {"m": 3.0, "rad": np.pi}, 1441  # of a path to both sides


def answer(task: Task) -> Answer:
    """With effects; of tracks, the joint of each object."""
    return {"corners": _seen, "track": _doors}.get(task.kind, _answer)(task)


def geometry(task: Task) -> Answer:
    """Without them."""
    return (_seen if task.kind == "corners" else _answer)(task, geometry_only=True)


def _answer(task: Task, geometry_only: bool = False) -> Answer:
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


def _seen(task: Task, geometry_only: bool = False) -> Answer:
    """From corners of a board; nothing is said of the lens."""
    import modcal
    from modcal_core.camera import BoardView, CameraImages, CameraProblem, solve_camera, target_from_data

    robot, square = modcal.Robot.from_urdf(task.urdf, tip=task.tip), float(task.board[0, 0])
    across, down = (len(np.unique(values)) + 1 for values in task.board[:, :2].T)
    width, height = across * square, down * square
    rulers = {"x_m": width, "y_m": height, "measured_x_m": width, "measured_y_m": height, "measured_std_m": RULER}
    told = {"modcal_target": 1, "type": "charuco", "columns": across, "rows": down, "square_m": square}
    target = target_from_data(told | {"marker_m": 0.7 * square, "dictionary": "DICT_5X5_100", "rulers": rulers})
    views = []
    for k, pixels in enumerate(task.reading.reshape(len(task.train), -1, 2)):
        ids = np.flatnonzero(np.isfinite(pixels[:, 0]))
        views.append(BoardView(f"{k:03d}", ids, pixels[ids], np.tile(PX**2 * np.eye(2), (len(ids), 1, 1))))
    images = CameraImages(task.q[task.train], views, target, (int(task.size[0]), int(task.size[1])))
    problem = CameraProblem(robot.chain, (images,), inertias=robot.inertias, look_for_effects=not geometry_only)
    solution = solve_camera(problem, np.random.default_rng(0))
    evidence = solution.evidence
    doubts = (*solution.claim.decision.problems, *evidence.open_points)
    return Answer(
        np.linalg.inv(solution.fit.seen_at(task.q)),
        # of the tool by what stands; where that is a camera, another length is scored
        claim_p95=P95 * solution.claim.in_view.interval[2] if task.on_tip else None,
        is_open=bool(doubts),
        named=tuple((str(cause.effect.family), str(cause.effect.place)) for cause in evidence.causes),
        parameters=len(solution.fit.x),
        remark="; ".join((solution.claim.decision.word, *doubts[:2])),
    )


def _doors(task: Task) -> Answer:
    """Each track by itself; a kind counts as named where modcal relies on it."""
    import modcal

    paths, named, unsure = [], [], 0
    for f in np.unique(task.frame):
        choice = modcal.articulate(modcal.Track.of_poses(task.reading[task.frame[task.train] == f]))
        model = choice.fit.model
        reach = REACH[model.unit]
        paths.append(model.pose(np.linspace(-reach, reach, POINTS)))
        named += [(choice.kind, str(f))] * choice.enough
        unsure += not choice.enough
    return Answer(np.stack(paths), named=tuple(named), remark=f"{unsure} of {len(paths)} left open")
