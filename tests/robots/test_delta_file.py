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


@pytest.mark.parametrize(
    ("part", "changes", "said"),
    [
        ("", {"modcal_delta": 2}, "modcal_delta: 2 is not one of 1"),
        ("", {"joints": "arm"}, "joints: 'arm' is not a list"),
        ("", {"colour": 1.0}, "unknown key colour"),
        ("arms", {"distal_m": None}, "arms: 'distal_m' is not stated"),
        ("arms", {"platform_radius_m": None}, "offset_m, or both"),
        ("arms", {"offset_m": 0.15}, "offset_m, or both"),
        ("arms", {"proximal_m": [0.3, 0.3]}, "proximal_m: it has 2 entries, 3 are allowed"),
        ("limits_rad", {"knee": [0.0, 1.0]}, "knee is no joint of it"),
        ("limits_rad", {"arm_1": [0.0]}, "arm_1: it has 1 entries, 2 are allowed"),
    ],
)
def test_what_is_not_understood_is_named(part: str, changes: dict[str, Any], said: str) -> None:
    data = deepcopy(STATED)
    (data.setdefault(part, {}) if part else data).update(changes)
    with pytest.raises(BadTable, match=said):
        delta_from_data(data, "delta.yaml")
