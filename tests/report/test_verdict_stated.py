"""What is stated of arm and instrument, on the command line and in a cell file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from modcal_core.calibration.stated import Stated
from modcal_core.errors import BadTable
from modcal_nodes.io.inputs import read_cell, stated_from


def test_repeatability_of_a_data_sheet_as_rms() -> None:
    """RP of ISO 9283 is the mean distance to the mean position plus three standard deviations of it."""
    rng = np.random.default_rng(0)
    gap = 0.03 * rng.standard_normal((400_000, 3))
    far = np.linalg.norm(gap - gap.mean(axis=0), axis=1)
    iso = far.mean() + 3.0 * far.std(ddof=1)
    rms = Stated(repeatability_iso_mm=iso).rms_mm
    assert rms == pytest.approx(np.sqrt(np.mean(far**2)), rel=0.005)


def test_what_cannot_be_stated_is_refused() -> None:
    for values in (
        {"repeatability_mm": 0.0},
        {"instrument_mm": -0.1},
        {"instrument_deg": 20.0},
        {"repeatability_mm": float("nan")},
        {"repeatability_mm": 0.02, "repeatability_iso_mm": 0.05},
    ):
        with pytest.raises(BadTable):
            Stated(**values)


def test_a_cell_file_states_the_same_and_the_command_line_goes_before_it(tmp_path: Path) -> None:
    file = tmp_path / "cell.yaml"
    file.write_text("fixed: [tool]\nrepeatability_iso: 0.05\ninstrument_mm: 0.02\ninstrument_deg: 0.01\n")
    cell = read_cell(file)
    assert cell.fixed == ("tool",)
    assert cell.stated == Stated(repeatability_iso_mm=0.05, instrument_mm=0.02, instrument_deg=0.01)
    both = read_cell(file, stated=stated_from({"repeatability_mm": 0.01, "instrument_mm": 0.03})).stated
    assert both == Stated(repeatability_mm=0.01, instrument_mm=0.03, instrument_deg=0.01)
    assert read_cell(None, stated=stated_from({"repeatability_iso": 0.1})).stated.rms_mm == pytest.approx(
        0.0479, abs=1e-4
    )


@pytest.mark.parametrize("text", ["repeatability_mm: some", "instrument_mm: [1]", "repeatability: 0.02"])
def test_what_cannot_be_read_is_refused(tmp_path: Path, text: str) -> None:
    file = tmp_path / "cell.yaml"
    file.write_text(text + "\n")
    with pytest.raises(BadTable, match=str(file)):
        read_cell(file)
