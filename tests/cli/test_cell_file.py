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


def test_payloads_are_taken_as_they_are_written(tmp_path: Path) -> None:
    file = tmp_path / "cell.yaml"
    file.write_text("payloads:\n  - {mass_kg: 2.5, centre_m: [0.01, 0, 0.05]}\n  - {mass_kg: 0}\n")
    first, second = read_cell(file).payloads
    assert (first.mass, first.place) == (2.5, (0.01, 0.0, 0.05))
    assert (second.mass, second.place) == (0.0, (0.0, 0.0, 0.0))
    file.write_text("distances: []\n")
    assert read_cell(file).payloads == ()


@pytest.mark.parametrize(
    ("payload", "said"),
    [
        ("{centre_m: [0, 0, 0.05]}", "mass_kg"),
        ("{mass_kg: -1}", "0 to .* kg within .* m of the tip are allowed"),
        ("{mass_kg: 1, centre_m: [0, 0, 50]}", "0 to .* kg within .* m of the tip are allowed"),
        ("{mass_kg: 1, centre_m: [0, 0]}", "payloads"),
        ("{mass_kg: 1, center_m: [0, 0, 0]}", "center_m"),
    ],
)
def test_a_payload_that_is_none_is_refused(payload: str, said: str, tmp_path: Path) -> None:
    file = tmp_path / "cell.yaml"
    file.write_text(f"payloads:\n  - {payload}\n")
    with pytest.raises(BadTable, match=said) as refused:
        read_cell(file)
    assert str(file) in str(refused.value)
