"""Whole runs of ``modcal calibrate``, from the start of the command to its exit, beside what they are meant to take.

Of each the processor's seconds of a process of its own, on one thread. The goal is that of a quiet machine like the one
of the published figures, times how much slower this one is at the moment; a ratio below 1 misses it. Real recordings
lie in ../shared/data; without them their rows say so.
"""

from __future__ import annotations

import csv
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import harness
import numpy as np
from timing import Row

from modcal_msgs_py.recording_write import write_recording

ROOT, DATA = harness.ROOT, harness.DATA
sys.path.append(str(ROOT / "bench" / "undeclared"))

Maker = Callable[[Path], Path]


def _grid(arm: str, table: str) -> Maker:
    """A table of commanded joints and reached positions, as a bag."""

    def make(folder: Path) -> Path:
        with (DATA / "serial_robots" / table).open() as stream:
            rows = list(csv.DictReader(stream))
        names = [key for key in rows[0] if key.startswith("joint_")]
        harness.succeeded("import", str(ROOT / f"examples/robots/{arm}.yaml"), "--out", str(folder / "arm.urdf"))
        from modcal_core.robots.urdf import read_chain

        joints = read_chain((folder / "arm.urdf").read_text()).names
        with (folder / "table.csv").open("w") as stream:
            out = csv.writer(stream)
            out.writerow([*joints, "x", "y", "z"])
            for row in rows:
                reached = [float(row[f"{axis}_t"]) - float(row[f"{axis}_dif"]) for axis in "xyz"]
                out.writerow([*(row[name] for name in names), *reached])
        mapping = folder / "table.yaml"
        mapping.write_text(
            "urdf: arm.urdf\ntables:\n  - files: table.csv\n    time: {order: {period_s: 10}}\n"
            f"    joints: {{unit: deg, columns: {{{', '.join(f'{name}: {name}' for name in joints)}}}}}\n"
            "    point: {frame: tracker, unit: mm, position: [x, y, z]}\n"
        )
        harness.succeeded("import", str(mapping), "--out", str(folder / "bag"))
        return folder / "bag"

    return make


def _series_a(folder: Path) -> Path:
    mapping = ROOT / "examples/import/ipa_ur10_series_a.yaml"
    harness.succeeded("import", str(mapping), "--data", str(DATA), "--out", str(folder / "bag"))
    return folder / "bag"


def _undeclared(scenario: str) -> Maker:
    def make(folder: Path) -> Path:
        from recordings import make as make_pair

        return Path(make_pair(scenario, "ur10", 0, folder).first)

    return make


def _lagging(folder: Path) -> Path:
    """Every joint is logged late, ripples and is elastic; one has backlash; heat, a tripod and a bump besides."""
    import recordings
    import scenarios

    rng = np.random.default_rng(11)
    cell = recordings.Cell("ur10", rng)
    plan = recordings.point_to_point(cell.arm, rng, 1000, 0.0)
    makers = [
        getattr(scenarios, name)
        for name in ("compliance_all", "approach_backlash", "thermal_none", "tripod_settling", "tool_bump")
    ]
    faults = list(recordings.plant(cell, tuple(makers), rng, float(plan.t[-1])))
    for i in range(cell.arm.n):
        for cycles in rng.choice(np.arange(1, 120), 3, replace=False):
            faults.append(_ripple(cell.arm.names[i], i, int(cycles), rng.uniform(1e-4, 3e-4), rng.uniform(0, 6)))
    recording, _, _ = recordings.record(cell, plan, tuple(faults), rng, True, True)
    track = recording.joints[0]
    behind = rng.normal(0, 1.5e-3, track.position.shape)
    told = replace(track, position=track.position + behind, received=track.stamps, topic="/joint_commands")
    late = replace(track, position=track.position - rng.uniform(0.3, 1.0, cell.arm.n) * behind)
    write_recording(replace(recording, joints=(late,)), folder / "bag", commanded=told)
    return folder / "bag"


def _ripple(name: str, i: int, cycles: int, size: float, phase: float):  # type: ignore[no-untyped-def]
    import scenarios

    def bend(arm, stations, deviation) -> None:  # type: ignore[no-untyped-def]
        deviation.x[:, i, scenarios.TURN] += size * np.sin(cycles * stations.q[:, i] + phase)

    return scenarios.Fault(("gear_harmonic",), (name,), (f"position:{name}",), "", bend)


def _moving(folder: Path) -> Path:
    """A hundred thousand poses in motion: a late tracker, a gear and a spring."""
    import recordings
    import scenarios

    rng = np.random.default_rng(5)
    cell = recordings.Cell("ur10", rng)
    plan = recordings.course(cell, rng, 2003.0, 0.0)
    makers = (scenarios.latency, scenarios.gear_harmonic, scenarios.compliance)
    faults = recordings.plant(cell, makers, rng, float(plan.t[-1]))
    write_recording(recordings.record(cell, plan, faults, rng, False, True)[0], folder / "bag")
    return folder / "bag"


# What is run, from which recording, with which options, the seconds it is meant to take, and whether it is a real one
WORK: tuple[tuple[str, Maker, tuple[str, ...], float, bool], ...] = (
    ("160 stations, nothing to find", _undeclared("none"), (), 1.2, False),
    ("160 stations, two effects", _undeclared("gear_harmonic+compliance"), (), 2.0, False),
    ("WAM grid, 216 stations", _grid("wam7", "wam_grid.csv"), (), 2.0, True),
    ("UR5 grid, 1 000 stations", _grid("ur5", "ur5_grid.csv"), (), 4.0, True),
    ("late joints, 1 000 stations", _lagging, (), 8.0, False),
    ("UR10 series A, 11 911 poses", _series_a, ("--block", "200"), 8.0, True),
    ("100 000 poses in motion, three effects", _moving, (), 20.0, False),
)


def rows(scale: float) -> Iterator[Row]:
    """A row a recording. scale: how many times slower this machine is at the moment."""
    for name, maker, options, goal, real in WORK:
        work = f"calibrate, {name}"
        if real and not DATA.is_dir():
            yield Row("whole runs", work, 0.0, remark="not run: ../shared/data is missing")
            continue
        with harness.scratch() as folder:
            seconds, memory = spent(maker(folder), folder / "out", options)
        yield Row("whole runs", work, 1e3 * seconds, "goal", 1e3 * goal * scale, remark=f"{memory:.0f} MB")


def spent(bag: Path, out: Path, options: tuple[str, ...] = ()) -> tuple[float, float]:
    """Seconds of the processor of one run of the command, and its memory at most [MB]."""
    command = [sys.executable, "-c", "from modcal_nodes.cli.main import main; main()", "calibrate"]
    # where Python may not keep what it compiled, every run would compile what was edited, and the templates of the page
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    child = subprocess.Popen([*command, bag, "--out", out, *options], stdout=subprocess.DEVNULL, env=kept)
    _, status, usage = os.wait4(child.pid, 0)  # of this child alone, not of all there have been
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode not in (0, 3):
        raise SystemExit(f"modcal calibrate {bag}: exit {child.returncode}")
    return usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1e3
