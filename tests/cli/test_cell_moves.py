"""What a cell file says of moves."""

from __future__ import annotations

from pathlib import Path

import pytest

from modcal_core.calibration.fit import Move
from modcal_core.errors import BadTable
from modcal_nodes.io.inputs import read_cell


def test_moves_are_read_in_order_of_time(tmp_path: Path) -> None:
    file = tmp_path / "cell.yaml"
    file.write_text("moved: [{stamp: 20.5, what: base}, {stamp: 10.5, what: tool}]\nown_in_recordings: both\n")
    cell = read_cell(file)
    assert cell.moved == (Move(10.5, "tool"), Move(20.5, "base"))
    assert cell.own_in_recordings == "both"
    assert [m.at for m in cell.with_move(Move(15.0, "both")).moved] == [10.5, 15.0, 20.5]


@pytest.mark.parametrize("text", ["moved: [{stamp: 1.0, what: table}]", "own_in_recordings: hand"])
def test_what_cannot_move_is_refused(text: str, tmp_path: Path) -> None:
    file = tmp_path / "cell.yaml"
    file.write_text(text)
    with pytest.raises(BadTable, match="base, tool, both"):
        read_cell(file)
