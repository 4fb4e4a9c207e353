"""Sockets that moved: the postures about them are of an iiwa in MuJoCo."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cells import samples_of

from modcal_core.errors import BadRecording
from modcal_core.geometry.so3 import Array
from modcal_core.hypotheses.socket_places import require_one_place
from modcal_core.measurements.samples import Samples
from modcal_core.robots.urdf import read_chain

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
CHAIN = read_chain((EXAMPLES / "robots" / "iiwa14.urdf").read_text(encoding="utf-8"))


def postures() -> dict[str, Array]:
    """Joint positions [rad] (N, 7) about each socket."""
    made = {}
    for path in sorted((EXAMPLES / "tables" / "sockets").glob("*.csv")):
        with path.open(encoding="utf-8") as stream:
            made[path.stem] = np.radians(np.array(list(csv.reader(stream))[1:], dtype=float))
    return made


def samples(of_each: dict[str, Array]) -> Samples:
    made = None
    for name, q in of_each.items():
        one = samples_of(CHAIN, q, np.tile(np.eye(4), (len(q), 1, 1)), "point", name)
        made = one if made is None else made.followed_by(one)
    assert made is not None
    return replace(made, sockets=tuple(of_each))


def test_sockets_that_stood_are_taken() -> None:
    require_one_place(samples(postures()), CHAIN)


def test_one_wrong_row_is_a_wrong_reading_and_no_other_place() -> None:
    of_each = postures()
    of_each["front_0"][3] = of_each["left_1"][4]
    require_one_place(samples(of_each), CHAIN)


@pytest.mark.parametrize("other", ["left_0", "front_1"])
def test_a_socket_in_two_places_is_refused_with_its_row_and_the_distance(other: str) -> None:
    of_each = postures()
    k = len(of_each["front_0"])
    of_each["front_0"] = np.concatenate([of_each["front_0"], of_each.pop(other)[: k // 2]])
    with pytest.raises(BadRecording) as told:
        require_one_place(samples(of_each), CHAIN)
    said = str(told.value)
    assert said.startswith("socket front_0:")
    assert f"from row {k + 1} on" in said
    if other == "front_1":  # its neighbour on the plate, 50 mm away
        assert any(f"front_0 is {mm} mm away" in said for mm in range(46, 55))


def test_rows_of_two_places_in_no_order_are_refused_as_well() -> None:
    of_each = postures()
    mixed = np.concatenate([of_each["front_0"], of_each.pop("raised_0")])
    of_each["front_0"] = np.random.default_rng(0).permutation(mixed)
    with pytest.raises(BadRecording, match="front_0 is in several"):
        require_one_place(samples(of_each), CHAIN)
