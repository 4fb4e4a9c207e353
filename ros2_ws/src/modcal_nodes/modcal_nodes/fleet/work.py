"""One recording of a fleet: calibrated where there is room, in whichever process or on whichever machine that is."""

from __future__ import annotations

import io
import time
import traceback
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from modcal_core.errors import ModcalError
from modcal_core.measurements.recording import SignalTrack
from modcal_core.measurements.samples import Samples
from modcal_core.measurements.thinning import spread_rows
from modcal_core.report.as_json import to_json_data
from modcal_core.result import Result
from modcal_nodes.fleet.task import DONE, FAILED, REFUSED, Outcome, Task
from modcal_nodes.io.recorded import calibrate_bag

SAMPLES = "samples.npz"
_MAX_KEPT = 5000  # samples, evenly chosen: a change of the arm is known far better than it matters
_MAX_NUMBERS = 2_000_000  # of signals beside them


def do(task: Task) -> Outcome:
    """Calibrate a bag. Never raises: what cannot be used is refused, and a fault of ours is a failure of this bag."""
    began = time.perf_counter()
    try:
        done = calibrate_bag(task.bag, task.options)
        files = {name: text.encode() for name, text in done.files.items()}
        files[SAMPLES] = _kept(done.result.samples)
        return Outcome(task.name, DONE, "", _row(done.result), files, time.perf_counter() - began)
    except ModcalError as error:
        return Outcome(task.name, REFUSED, str(error), took=time.perf_counter() - began)
    except Exception as error:
        said = " ".join(f"{type(error).__name__}: {error}".split())
        return Outcome(task.name, FAILED, said, took=time.perf_counter() - began, trace=traceback.format_exc())


def _row(done: Result) -> dict[str, Any]:
    """What the table says of a calibration, but for names and times that are known elsewhere."""
    data = to_json_data(done.report)
    seen, calibration = data["identifiability"], done.calibration
    sizes = {
        f"{stage}_{size}_mm": None if of_stage is None else of_stage[size]
        for stage, of_stage in data["error_mm"].items()
        for size in ("rms", "p95")
    }
    return {
        "model": done.robot.name,
        "kinematics": calibration.robot,
        "started": iso(done.samples.origin.began or 0.0),
        "duration_s": data["recording"]["duration_s"],
        "measurement": data["recording"]["measurement"],
        "stations": data["recording"]["stations"],
        "rejected": data["recording"]["rejected"],
        **sizes,
        "floor_mm": data["noise_floor_mm"],
        "unexplained_mm": None if data["unexplained"] is None else data["unexplained"]["size_mm"],
        "rank": None if seen is None else seen["rank"],
        "condition": None if seen is None else seen["condition"],
        "effects": [f"{e['family']} at {e['place']} by {e['driver']}" for e in data["effects"]],
        "parameters": [*data["parameters"], *_effect_values(data["effects"])],
        "status": data["status"],
        "open_because": data["open_because"],
        "verdict": data["verdict"],
    }


def iso(stamp: float) -> str:
    """A stamp [s] as date and time, UTC."""
    return datetime.fromtimestamp(stamp, UTC).isoformat(timespec="milliseconds")


def _effect_values(effects: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [
        {"name": f"{e['family']} {e['place']}/{name}", **value}
        for e in effects
        for name, value in e["parameters"].items()
    ]


def _kept(samples: Samples) -> bytes:
    """The samples as the bytes of an .npz, thinned; signals only where they are few enough."""
    if len(samples) > _MAX_KEPT:
        samples = samples.select(spread_rows(len(samples), _MAX_KEPT))
    signals = samples.signals if sum(s.values.size for s in samples.signals) <= _MAX_NUMBERS else ()
    arrays: dict[str, Any] = {f"of_{name}": getattr(samples, name) for name in _ARRAYS}
    arrays |= {"names": np.array(samples.names), "frames": np.array(samples.frames)}
    arrays["signals"] = np.array([[s.name, s.topic] for s in signals]).reshape(-1, 2)
    for i, signal in enumerate(signals):
        arrays |= {f"stamps_{i}": signal.stamps, f"values_{i}": signal.values}
    out = io.BytesIO()
    np.savez_compressed(out, allow_pickle=False, **arrays)
    return out.getvalue()


def read_samples(path: Path) -> Samples:
    """The samples that were kept beside a calibration. Raises OSError, ValueError or KeyError for what is none."""
    with np.load(path, allow_pickle=False) as kept:
        signals = tuple(
            SignalTrack(str(name), kept[f"stamps_{i}"], kept[f"values_{i}"], str(topic))
            for i, (name, topic) in enumerate(kept["signals"])
        )
        names, frames = (tuple(str(x) for x in kept[k]) for k in ("names", "frames"))
        return Samples(
            names, frames, **{name: kept[f"of_{name}"] for name in _ARRAYS if f"of_{name}" in kept}, signals=signals
        )


_ARRAYS = (
    *("q", "stamps", "station", "frame", "kind", "reading", "R", "sigma_position", "sigma_rotation"),
    *("velocity", "moving", "acceleration", "approach", "effort", "following"),
)
