"""The file of a Delta: what it says comes back, and what it must not say is refused by name."""

from __future__ import annotations

from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from deltas import FILE, nominal, postures

from modcal_core.errors import BadTable
from modcal_core.files import to_yaml
from modcal_core.robots.delta import OFFSET, delta_from_data, delta_to_data
from modcal_core.robots.delta_kinematics import tool_pose
from modcal_nodes.io.inputs import read_delta
from modcal_nodes.simulation.delta_world import displaced

STATED: dict[str, Any] = yaml.safe_load(FILE.read_text())


def test_a_delta_comes_back_from_its_file_as_it_was(tmp_path: Path) -> None:
    delta = displaced(nominal(), np.random.default_rng(0), 1e-3, 1e-3)
    file = tmp_path / "delta.yaml"
    file.write_text(to_yaml(delta_to_data(delta)))
    again = read_delta(file)
    assert again.names == delta.names
    q = postures(delta, 10)
    assert np.array_equal(tool_pose(again, q), tool_pose(delta, q))
    assert np.array_equal(again.lower, delta.lower)


def test_radii_or_their_difference() -> None:
    by_offset = deepcopy(STATED)
    del by_offset["arms"]["fixed_radius_m"], by_offset["arms"]["platform_radius_m"]
    by_offset["arms"]["offset_m"] = 0.15
    a, b = delta_from_data(STATED, "a"), delta_from_data(by_offset, "b")
    assert np.allclose(a.constants, b.constants, rtol=0.0, atol=1e-15)
    assert np.allclose(a.constants[OFFSET], 0.15)


def without(*path: str) -> dict[str, Any]:
    data = deepcopy(STATED)
    inner = data
    for key in path[:-1]:
        inner = inner[key]
    del inner[path[-1]]
    return data


def with_value(value: Any, *path: str) -> dict[str, Any]:
    data = deepcopy(STATED)
    inner = data
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    return data


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (None, "lacks modcal_delta"),
        ({"modcal_delta": 2}, "modcal_delta 2"),
        (without("joints"), "must name three arms"),
        (with_value("arm", "joints"), "must name three arms"),
        (without("arms"), "arms: must have"),
        (without("arms", "distal_m"), "lacks distal_m"),
        (without("arms", "platform_radius_m"), "offset_m, or both"),
        (with_value(0.15, "arms", "offset_m"), "offset_m, or both"),
        (with_value("long", "arms", "distal_m"), "arms: distal_m: needs 3 finite numbers"),
        (with_value([0.3, 0.3], "arms", "proximal_m"), "arms: proximal_m: needs 3 finite numbers"),
        (with_value(0.3, "arms", "proximal_mm"), "'proximal_mm' is not one of its keys"),
        (with_value(1.0, "colour"), "'colour' is not one of its keys"),
        (with_value([0.0, 1.0], "limits_rad", "knee"), "'knee' is not one of its keys"),
        (with_value([0.0], "limits_rad", "arm_1"), "arm_1: needs 2 finite numbers"),
        (with_value([1, 2], "limits_rad"), "limits_rad: must have a pair"),
        (with_value([1, 2, 3], "tool"), "tool: must have position_m"),
        (with_value([1.0], "tool", "position_m"), "position_m: needs 3"),
    ],
)
def test_what_is_not_understood_is_named(data: Any, said: str) -> None:
    with pytest.raises(BadTable, match=said):
        delta_from_data(data, "delta.yaml")
