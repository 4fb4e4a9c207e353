"""A description that is no robot's, by its size or its depth, is refused in one line and at once."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest

from modcal_core.articulation.urdf import read
from modcal_core.errors import BadRobot, ModcalError
from modcal_core.robots.acceleration import LoadedArm
from modcal_core.robots.urdf import read_chain

MASS = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'


def described(count: int, parent: Callable[[int], int]) -> str:
    """One moving joint, and fixed ones behind it to so many in all; parent: of each link by number."""
    links = "".join(f'<link name="l{k}">{MASS}</link>' for k in range(count + 1))
    joints = "".join(
        f'<joint name="j{k}" type="{"fixed" if k > 1 else "revolute"}"><parent link="l{parent(k)}"/><child link="l{k}"/>'
        '<axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="9" velocity="1"/></joint>'
        for k in range(1, count + 1)
    )
    return f'<robot name="r">{links}{joints}</robot>'


def row(count: int) -> str:
    """So many joints in a row."""
    return described(count, lambda k: k - 1)


@pytest.mark.slow
@pytest.mark.parametrize("reader", [read_chain, LoadedArm.read])
def test_joints_in_a_row_up_to_the_limit_are_read(reader: Callable[[str], object]) -> None:
    assert reader(row(250))
    for count in (251, 3000):
        begun = time.perf_counter()
        with pytest.raises(BadRobot, match=r"has (251 joints in a row, 250|3001 links, 2000) is the limit"):
            reader(row(count))
        assert time.perf_counter() - begun < 2.0


def test_a_loop_is_called_a_loop() -> None:
    tied = row(400).replace('<parent link="l0"/>', '<parent link="l400"/>')
    with pytest.raises(BadRobot, match="closes a loop"):
        read_chain(tied)


@pytest.mark.slow
def test_a_description_of_fifty_megabytes_is_not_parsed() -> None:
    for text in (row(3) + " " * 50_000_000, row(3).replace("<link", "<!--" + "x" * 50_000_000 + "--><link", 1)):
        begun = time.perf_counter()
        with pytest.raises(BadRobot, match="million characters, 5 million is the limit"):
            read_chain(text)
        assert time.perf_counter() - begun < 0.5


def test_other_texts_on_topics_are_bounded_too() -> None:
    begun = time.perf_counter()
    with pytest.raises(ModcalError, match="is the limit"):
        read("a" * 50_000_000)
    assert time.perf_counter() - begun < 0.5
