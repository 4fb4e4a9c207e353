"""Known distances of a cell file: what no distance can be is refused before anything is fitted."""

from __future__ import annotations

from pathlib import Path

import pytest

from modcal_core.errors import BadTable
from modcal_nodes.io.inputs import read_cell


@pytest.mark.slow
@pytest.mark.parametrize("value", ["-0.3", "0.0", "50.0", "300.0", ".nan"])
def test_a_distance_that_is_none_is_refused(value: str, tmp_path: Path) -> None:
    file = tmp_path / "cell.yaml"
    file.write_text(f"distances:\n  - {{between: [a, b], distance_m: {value}}}\n")
    with pytest.raises(
        BadTable, match="distance_m: nan is not a finite number" if value == ".nan" else "0 to 50 m is allowed"
    ):
        read_cell(file)


def test_a_distance_is_taken_as_it_is_written(tmp_path: Path) -> None:
    file = tmp_path / "cell.yaml"
    file.write_text("distances:\n  - {between: [a, b], distance_m: 0.3, std_m: 1.0e-4}\n")
    (known,) = read_cell(file).distances
    assert (known.distance, known.std) == (0.3, 1e-4)
