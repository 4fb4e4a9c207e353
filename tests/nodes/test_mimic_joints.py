"""A joint inside the arm that mimics another and that no joint state names: the calibrator knows the arm none the less."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from modcal_nodes.calibrating.intake import KnownArm

_JOINT = (
    '<joint name="{0}" type="revolute"><parent link="l{1}"/><child link="l{2}"/><origin xyz="0 0 0.3"/>'
    '<axis xyz="0 1 0"/><limit lower="-3" upper="3" effort="1" velocity="1"/>{3}</joint>'
)


def test_the_calibrator_fills_it_in() -> None:
    mimic = ("", "", '<mimic joint="a" multiplier="-1"/>')
    links = "".join(f'<link name="l{i}"/>' for i in range(4))
    joints = "".join(_JOINT.format(name, i, i + 1, mimic[i]) for i, name in enumerate("abc"))
    arm = KnownArm(f'<robot name="r">{links}{joints}</robot>', "l0", "l3")
    assert arm.recognise(frozenset("ab"))
    stamp = SimpleNamespace(sec=1, nanosec=0)
    q = np.array([0.4, 0.1]).tobytes()
    message = SimpleNamespace(header=SimpleNamespace(stamp=stamp), name=["b", "a"], position=q, effort=b"")
    arm.joint_state(message)
    told = arm.position(message)
    assert told is not None
    assert np.allclose(told, [0.1, 0.4, -0.1])
