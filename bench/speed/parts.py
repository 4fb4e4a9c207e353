"""Times of single parts: kinematics, one sample more, a scan, a hinge, bags, a search, the start of the command."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import harness
import numpy as np
import pinocchio as pin
import yaml
from articulation.objects import ideal, noisy
from cells import record, ur10
from cli.recordings import streams
from peers import ask
from rosbags.rosbag2 import Reader, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.optimize import least_squares
from timing import Row, median_ms, pair_ms, spent_ms

from modcal_core.articulation.fit import fit as fit_joint
from modcal_core.articulation.track import Track
from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.calibration.fit import identify, priors
from modcal_core.calibration.structure import choose_parameters, views_of
from modcal_core.diagnosis.evidence import Scanner
from modcal_core.effects.registry import candidates
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import cut_stations
from modcal_core.modules.coding import Coding
from modcal_core.modules.evaluation import Evaluator, SearchSettings, evolve
from modcal_core.modules.library import published
from modcal_core.modules.synthesis import task_from_data
from modcal_core.online.estimator import Estimator
from modcal_core.online.supervisor import ChangeDetector
from modcal_core.robots.kinematics import chain_forward, spatial_jacobian
from modcal_core.robots.mechanism import inverse
from modcal_core.robots.urdf import read_chain
from modcal_msgs_py.mcap_read import read_recording
from modcal_msgs_py.recording_write import write_recording

ROOT = harness.ROOT
URDF = ROOT / "examples" / "robots" / "ur10.urdf"
POSTURES, ROWS, STATIONS, JUDGED = 10_000, 256, 160, 300
POSES, DOORS = 100, 5
POSITION, ROTATION = 5e-4, 2e-3  # noise of every axis [m, rad]
SAME_HINGE = (5e-3, 0.01)  # m, rad that two hinges found in the same poses may lie apart


def kinematics() -> Iterator[Row]:
    """Ours are batched; Pinocchio is called posture by posture, as its Python users do."""
    urdf = URDF.read_text()
    model = pin.buildModelFromXML(urdf)
    data, frame, last = model.createData(), model.getFrameId("tool0"), model.joints[model.njoints - 1].id
    chain, q = read_chain(urdf), np.random.default_rng(0).uniform(-3, 3, (POSTURES, 6))

    def poses() -> Any:
        out = np.empty((len(q), 4, 4))
        for i, posture in enumerate(q):
            pin.framesForwardKinematics(model, data, posture)
            out[i] = data.oMf[frame].homogeneous
        return out

    def jacobians() -> Any:
        out = np.empty((len(q), 6, 6))
        for i, posture in enumerate(q):
            pin.computeJointJacobians(model, data, posture)
            out[i] = pin.getJointJacobian(model, data, last, pin.WORLD)
        return out

    for name, ours, theirs in (("FK", chain_forward, poses), ("Jacobian", spatial_jacobian, jacobians)):
        assert np.abs(theirs() - ours(chain, q)).max() < 1e-12
        times = pair_ms(lambda ours=ours: ours(chain, q), theirs, 7, 3)
        yield Row(f"{name}, {POSTURES} postures", times[0], "Pinocchio in a loop", times[1])
    chain, near = ur10(), np.array([0.3, -1.2, 1.4, -0.8, 1.1, 0.2])
    T = chain_forward(chain, near)

    gap = lambda x: se3.log(se3.inverse(chain_forward(chain, x)) @ T)  # noqa: E731
    peer = lambda: least_squares(gap, near + 0.01, xtol=1e-15, ftol=1e-15, gtol=1e-15).x  # noqa: E731
    assert np.abs(peer() - inverse(chain, T, near + 0.01)).max() < 1e-7
    times = pair_ms(lambda: inverse(chain, T, near + 0.01), peer, 25, 10)
    yield Row("IK, from nearby", times[0], "SciPy least_squares", times[1])


def online() -> Iterator[Row]:
    """What one sample more costs, against a batch fit of all; its solution and the running one are the same."""
    samples = record(1, 1_000, "pose").samples
    start = fit_cell(ur10(), samples, Cell()).model
    parameters = choose_parameters(start, views_of(samples)).parameters
    fit = identify(start, samples, parameters, robust=False)
    single = [samples.select(np.array([i])) for i in range(len(samples))]
    _, prior = priors(start.effects, parameters, start.drivers(samples))
    running = Estimator(start, parameters, fit.noise, np.diag(prior**2), robust=False)
    for row in single:
        running.update(row)
    running.linearise_again()
    apart = float(np.abs((running.values - fit.values) / fit.std).max())
    if apart > 1e-2:
        raise SystemExit(f"the running estimate is {apart:.2g} standard deviations from the batch")
    estimator = Estimator(fit.model, fit.parameters, fit.noise, fit.covariance)
    watch = ChangeDetector(fit.model, fit.parameters, fit.covariance, fit.noise)
    batch = lambda: identify(fit.model, samples, parameters)  # noqa: E731
    ours, other = pair_ms(lambda: [estimator.update(row) for row in single[:ROWS]], batch, 5)
    yield Row("recursive update, one pose", ours / ROWS, "batch fit of 1000", other)
    yield Row("watch, one pose", median_ms(lambda: [watch.add(row) for row in single[:ROWS]], 3) / ROWS)


def diagnosis() -> Iterator[Row]:
    """The whole dictionary on 160 stations: to set up, and to weigh."""
    samples = record(2, STATIONS, "pose").samples
    start = fit_cell(ur10(), samples, Cell()).model
    fit = identify(start, samples, choose_parameters(start, views_of(samples)).parameters)

    def scan() -> int:
        at = fit.model.drivers(samples)
        effects = list(candidates(at))
        Scanner(effects, at).evidence(fit)
        return len(effects)

    ms = median_ms(scan, 3)
    yield Row(f"scan, {STATIONS} stations", ms, remark=f"{scan()} candidates")


def _apart(hinge: Array, other: Array) -> tuple[float, float]:
    """How far the first hinge's point is from the other's line [m], and the angle of the two lines [rad].

    A hinge is a point on its axis and the axis (6,).
    """
    away, axis = hinge[:3] - other[:3], other[3:]
    angle = float(np.arctan2(np.linalg.norm(np.cross(hinge[3:], axis)), abs(hinge[3:] @ axis)))
    return float(np.linalg.norm(away - axis * (axis @ away))), angle


def _off(hinges: Array, truth: Array) -> str:
    """Mean errors of hinges, in words."""
    errors = np.mean([_apart(a, b) for a, b in zip(hinges, truth, strict=True)], axis=0)
    return f"{1e3 * errors[0]:.2f} mm and {np.degrees(errors[1]):.2f} deg"


def articulation() -> Iterator[Row]:
    """The fit of a known kind of joint, and the same by ripl_articulation's factor graph."""
    seen = []
    for seed in range(DOORS):  # a door with its handle 0.5 m from the hinge, opened once
        rng = np.random.default_rng(seed)
        door = ideal("revolute", np.linspace(0.0, 1.2, POSES), rng, 0.5)
        seen.append(noisy(door, rng, POSITION, ROTATION))
    tracks = [Track(s.positions, s.rotations) for s in seen]
    models = [fit_joint(track, "revolute").model for track in tracks]
    truth, ours = (np.array([np.r_[m.point, m.axis] for m in those]) for those in (seen, models))
    ms = float(np.median([median_ms(lambda t=track: fit_joint(t, "revolute"), 3) for track in tracks]))
    poses = np.tile(np.eye(4), (DOORS, POSES, 1, 1))
    poses[..., :3, :3], poses[..., :3, 3] = [s.rotations for s in seen], [s.positions for s in seen]
    answer = ask("ripl", seconds=120.0, arrays={"poses": poses, "position": POSITION, "rotation": ROTATION})
    remark = answer.remark
    if answer.found:
        theirs = np.reshape(answer.found, (DOORS, 6))
        for a, b in zip(theirs, ours, strict=True):
            if (np.array(_apart(a, b)) > SAME_HINGE).any():
                raise SystemExit(f"ripl_articulation: another hinge, {_apart(a, b)} m and rad away")
        remark = f"off the true hinge by {_off(theirs, truth)}, ours by {_off(ours, truth)}"
    yield Row(f"hinge from {POSES} poses", ms, "ripl_articulation", answer.ms, remark)


def bags() -> Iterator[Row]:
    """Reading a stream of joint states and poses. All of them decode every message into numbers."""
    with tempfile.TemporaryDirectory() as folder:
        bag, sqlite = Path(folder) / "bag", Path(folder) / "sqlite"
        recording = streams(60)
        write_recording(recording, bag)
        store = get_typestore(Stores.ROS2_JAZZY)

        def peer(bag: Path) -> Any:
            with Reader(bag) as reader:
                return [(c.topic, store.deserialize_cdr(raw, c.msgtype)) for c, _, raw in reader.messages()]

        read = peer(bag)
        q = np.array([message.position for topic, message in read if topic == "/joint_states"])
        with Reader(bag) as reader, Writer(sqlite, version=9) as writer:
            known = {c.id: writer.add_connection(c.topic, c.msgtype, typestore=store) for c in reader.connections}
            for connection, stamp, raw in reader.messages():
                writer.write(known[connection.id], stamp, raw)
        for file, kind in ((bag, ""), (sqlite, ", SQLite")):
            assert np.array_equal(q, read_recording(file).joints[0].position), "other joint positions"
            ours, other = pair_ms(lambda file=file: read_recording(file), lambda file=file: peer(file), 5, 3)
            rate = f"{len(read) / ours:.0f} k messages/s into arrays"
            yield Row(f"{len(read)} messages{kind}", ours, "rosbags", other, rate)
            if not kind:
                answer = ask("mcap", str(next(bag.glob("*.mcap"))))
                yield Row(f"{len(read)} messages", ours, "mcap-ros2-support", answer.ms, answer.remark)
        track = recording.joints[0]
        ms = median_ms(lambda: cut_stations(recording, track.names), 3)
        yield Row(f"stations of {len(track.stamps)} joint states", ms)


def synthesis() -> Iterator[Row]:
    """Assemblies judged by the genetic search in the published two-pose task; bench/synthesis.py: how well it does."""
    library, name = published(), "two_poses.yaml"
    task = task_from_data(yaml.safe_load((ROOT / "examples" / "synthesis" / name).read_text()), name)
    evaluator, judged = Evaluator(library, task.targets, task.uses, 0), []

    def search() -> None:
        settings, rng = SearchSettings(generations=JUDGED, patience=JUDGED), np.random.default_rng([0, 5])
        archive = evolve(Coding(library), 5, evaluator, rng, settings, enough=lambda archive: archive.judged >= JUDGED)
        judged.append(archive.judged)

    ms = spent_ms(search)
    yield Row("one assembly judged", ms / judged[-1], remark=f"mean of {judged[-1]}, descents included")


def process_ms(*arguments: str, runs: int = 5) -> float:
    """Median of the processor's time of a process with these arguments, its system's included [ms]."""
    times = []
    for _ in range(runs + 1):
        before = os.times()
        subprocess.run(arguments, check=True, stdout=subprocess.DEVNULL)
        after = os.times()
        spent = after.children_user + after.children_system - before.children_user - before.children_system
        times.append(1e3 * spent)
    return float(np.median(times[1:]))


def start() -> Iterator[Row]:
    """What the command costs before it does anything, beside an interpreter that does nothing, and NumPy alone."""
    command = str(Path(sys.executable).with_name("modcal"))
    bare, numpy = (process_ms(sys.executable, "-c", words) for words in ("pass", "import numpy"))
    yield Row("modcal --help", process_ms(command, "--help"), "python -c pass", bare, "0.1 s is the limit")
    info = process_ms(command, "info", str(ROOT / "bags" / "ur10_cell"))
    yield Row("modcal info, a small bag", info, "import numpy", numpy, "0.3 s is the limit")
    with tempfile.TemporaryDirectory() as folder:
        plan = process_ms(command, "plan", str(URDF), "--stations", "26", "--candidates", "500", "--out", folder)
    yield Row("modcal plan, 26 of 500 candidates", plan, "import numpy", numpy, "1.5 s is the limit")
