"""What a cell file states of distances, payloads, moves, the instrument and topics; what it cannot state is refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from modcal_core.calibration.fit import Move
from modcal_core.calibration.stated import Stated
from modcal_core.errors import BadTable
from modcal_msgs_py import Topics
from modcal_nodes.io.inputs import read_cell, read_topics, stated_from


def written(folder: Path, text: str) -> Path:
    """A cell file with this text."""
    (folder / "cell.yaml").write_text(text + "\n")
    return folder / "cell.yaml"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        *((f"distances: [{{between: [a, b], distance_m: {mm}}}]", "0 to 50 m is allowed") for mm in (-0.3, 0.0, 50.0)),
        ("distances: [{between: [a, b], distance_m: .nan}]", "distance_m: nan is not a finite number"),
        ("payloads: [{centre_m: [0, 0, 0.05]}]", "mass_kg"),
        ("payloads: [{mass_kg: -1}]", "0 to .* kg within .* m of the tip are allowed"),
        ("payloads: [{mass_kg: 1, centre_m: [0, 0, 50]}]", "0 to .* kg within .* m of the tip are allowed"),
        ("payloads: [{mass_kg: 1, centre_m: [0, 0]}]", "payloads"),
        ("payloads: [{mass_kg: 1, center_m: [0, 0, 0]}]", "center_m"),
        ("moved: [{stamp: 1.0, what: table}]", "base, tool, both"),
        ("own_in_recordings: hand", "base, tool, both"),
        ("repeatability_mm: some", "repeatability_mm"),
        ("instrument_mm: [1]", "instrument_mm"),
        ("repeatability: 0.02", "repeatability"),
        ("topics: {tracker/pose: 3}", "topics"),
        ("topics: {tool: /a}", "tool"),
        ("tf: a", "tf"),
        ("ignore: [3]", "ignore"),
    ],
)
def test_what_cannot_be_is_refused_with_the_file(text: str, said: str, tmp_path: Path) -> None:
    file = written(tmp_path, text)
    with pytest.raises(BadTable, match=said) as refused:
        read_topics(file, Topics()) if text.startswith(("topics", "tf", "ignore")) else read_cell(file)
    assert text.startswith(("topics", "tf")) or str(file) in str(refused.value)


def test_what_is_stated_is_taken_as_it_is_written(tmp_path: Path) -> None:
    cell = read_cell(
        written(
            tmp_path,
            "distances: [{between: [a, b], distance_m: 0.3, std_m: 1.0e-4}]\n"
            "payloads: [{mass_kg: 2.5, centre_m: [0.01, 0, 0.05]}, {mass_kg: 0}]\n"
            "moved: [{stamp: 20.5, what: base}, {stamp: 10.5, what: tool}]\nown_in_recordings: both",
        )
    )
    (known,) = cell.distances
    assert (known.distance, known.std) == (0.3, 1e-4)
    assert [(one.mass, one.place) for one in cell.payloads] == [(2.5, (0.01, 0.0, 0.05)), (0.0, (0.0, 0.0, 0.0))]
    assert cell.moved == (Move(10.5, "tool"), Move(20.5, "base"))
    assert cell.own_in_recordings == "both"
    assert [m.at for m in cell.with_move(Move(15.0, "both")).moved] == [10.5, 15.0, 20.5]


def test_the_command_line_goes_before_the_file(tmp_path: Path) -> None:
    file = written(tmp_path, "fixed: [tool]\nrepeatability_iso: 0.05\ninstrument_mm: 0.02\ninstrument_deg: 0.01")
    cell = read_cell(file)
    assert cell.fixed == ("tool",)
    assert cell.stated == Stated(repeatability_iso_mm=0.05, instrument_mm=0.02, instrument_deg=0.01)
    both = read_cell(file, stated=stated_from({"repeatability_mm": 0.01, "instrument_mm": 0.03})).stated
    assert both == Stated(repeatability_mm=0.01, instrument_mm=0.03, instrument_deg=0.01)
    alone = read_cell(None, stated=stated_from({"repeatability_iso": 0.1})).stated
    assert alone.rms_mm == pytest.approx(0.0479, abs=1e-4)
