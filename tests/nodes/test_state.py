"""What the calibrator keeps comes back as it was, and what is damaged is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from cells import record
from nodes.processes import ROOT

from modcal_core.errors import BadTable
from modcal_core.loop import calibrate
from modcal_core.measurements.recording import SignalTrack
from modcal_core.measurements.samples import Samples
from modcal_core.report.report import calibration_files
from modcal_nodes.calibrating.state import State, read_state, write_state


@pytest.mark.slow
def test_state_comes_back(tmp_path: Path) -> None:
    cell = record(3, 60)
    track = SignalTrack("temperature:arm", np.arange(5.0), np.arange(5.0)[:, None], "/temperature")
    samples = Samples(**{**vars(cell.samples), "signals": (track,)})
    result = calibrate(samples, cell.world.nominal, np.random.default_rng(0), look_for_effects=False)
    urdf = (ROOT / "examples" / "robots" / "ur10.urdf").read_text()
    files = calibration_files(result.calibration, result.report, cell.world.nominal, urdf)
    write_state(tmp_path / "state", State(result.calibration, files, samples))
    back = read_state(tmp_path / "state")
    assert back.calibration is not None
    assert back.samples is not None
    assert back.files is not None
    q = np.random.default_rng(1).uniform(-1.5, 1.5, (10, 6))
    assert (back.calibration.calibrated.predict(q) == result.calibration.calibrated.predict(q)).all()
    for name, value in vars(samples).items():
        kept = getattr(back.samples, name)
        if isinstance(value, np.ndarray):
            assert np.array_equal(kept, value, equal_nan=value.dtype.kind == "f"), name
    assert back.samples.signals[0].name == track.name
    assert (back.samples.signals[0].values == track.values).all()
    assert back.files["calibration.yaml"] == files["calibration.yaml"]


def test_nothing_is_read_where_nothing_was_kept(tmp_path: Path) -> None:
    assert read_state(tmp_path / "none") == State()


def test_damaged_stations_are_refused(tmp_path: Path) -> None:
    write_state(tmp_path, State(samples=record(3, 10).samples))
    file = tmp_path / "samples.npz"
    file.write_bytes(file.read_bytes()[:200])
    with pytest.raises(BadTable, match=r"samples\.npz.*is damaged"):
        read_state(tmp_path)
