"""Whole runs of ``modcal calibrate``, from the start of the command to its exit, beside what they are meant to take.

Of each the processor's seconds of a process of its own, on one thread. The goal is that of a quiet machine like the one
of the published figures, times how much slower this one is at the moment; a ratio below 1 misses it. Real recordings
lie in ../shared/data; without them their rows say so.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import harness
import numpy as np
import recordings
import scenarios
from recorded import imported
from sites import Bend, Cell, course, point_to_point, turned
from timing import Row

from modcal_msgs_py.recording_write import write_recording


def _grid(name: str, folder: Path) -> Path:
    """A table of commanded joints and reached positions, as a bag."""
    from tables import published

    table = published(name)
    for file, text in table.files("bag").items():
        (folder / file).write_text(text, encoding="utf-8")
    for step in table.imports("bag"):
        harness.succeeded(*(folder / a[1:-1] if a.startswith("{") else a for a in step))
    return folder / "bag"


def _undeclared(scenario: str, folder: Path) -> Path:
    return recordings.make(scenario, "ur10", 0, folder)[0]


def _ripple(i: int, cycles: int, size: float, phase: float) -> Bend:
    return turned(i, lambda s: size * np.sin(cycles * s.q[:, i] + phase))


def _lagging(folder: Path) -> Path:
    """Every joint is logged late, ripples and is elastic; one has backlash; heat, a tripod and a bump besides."""
    rng = np.random.default_rng(11)
    cell = Cell("ur10", rng)
    plan = point_to_point(cell.arm, rng, 1000, 0.0)
    names = ("compliance_all", "approach_backlash", "thermal_none", "tripod_settling", "tool_bump")
    makers = tuple(getattr(scenarios, name) for name in names)
    faults = list(recordings.plant(cell, makers, rng, float(plan.t[-1])))
    for i in range(cell.arm.n):
        for cycles in rng.choice(np.arange(1, 120), 3, replace=False):
            ripple = _ripple(i, int(cycles), rng.uniform(1e-4, 3e-4), rng.uniform(0, 6))
            faults.append(scenarios.Fault((), (), (), "", ripple))
    recording, _, _ = recordings.record(cell, plan, tuple(faults), rng, True, True)
    track = recording.joints[0]
    behind = rng.normal(0, 1.5e-3, track.position.shape)
    told = replace(track, position=track.position + behind, received=track.stamps, topic="/joint_commands")
    late = replace(track, position=track.position - rng.uniform(0.3, 1.0, cell.arm.n) * behind)
    write_recording(replace(recording, joints=(late,), commands=(told,)), folder / "bag")
    return folder / "bag"


def _moving(folder: Path) -> Path:
    """A hundred thousand poses in motion: a late tracker, a gear and a spring."""
    rng = np.random.default_rng(5)
    cell = Cell("ur10", rng)
    plan = course(cell, rng, 2003.0, 0.0)
    makers = (scenarios.latency, scenarios.gear_harmonic, scenarios.compliance)
    faults = recordings.plant(cell, makers, rng, float(plan.t[-1]))
    write_recording(recordings.record(cell, plan, faults, rng, False, True)[0], folder / "bag")
    return folder / "bag"


# What is run, from which recording, with which options, the seconds it is meant to take, and whether it is a real one
WORK: tuple[tuple[str, Callable[[Path], Path], tuple[str, ...], float, bool], ...] = (
    ("160 stations, nothing to find", partial(_undeclared, "none"), (), 1.2, False),
    ("160 stations, two effects", partial(_undeclared, "gear_harmonic+compliance"), (), 2.0, False),
    ("WAM grid, 216 stations", partial(_grid, "wam7"), (), 2.0, True),
    ("UR5 grid, 1 000 stations", partial(_grid, "ur5"), (), 4.0, True),
    ("late joints, 1 000 stations", _lagging, (), 8.0, False),
    ("UR10 series A, 11 911 poses", partial(imported, "ipa_ur10_series_a"), ("--block", "200"), 8.0, True),
    ("100 000 poses in motion, three effects", _moving, (), 20.0, False),
)


def rows(scale: float) -> Iterator[Row]:
    """A row a recording. scale: how many times slower this machine is at the moment."""
    for name, maker, options, goal, real in WORK:
        if real and not harness.DATA.is_dir():
            yield Row(f"calibrate, {name}", 0.0, remark="not run: ../shared/data is missing")
            continue
        with harness.scratch() as folder:
            seconds, memory = spent(maker(folder), folder / "out", options)
        told = "goal", 1e3 * goal * scale, f"{memory:.0f} MB"
        yield Row(f"calibrate, {name}", 1e3 * seconds, *told)


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
