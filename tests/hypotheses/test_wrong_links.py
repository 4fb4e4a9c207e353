"""Of a description with one wrong link that link is named, and none where it takes more than one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import record, samples_of, ur10
from scipy.spatial.transform import Rotation

from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.hypotheses.hypothesis import Disagreement
from modcal_core.hypotheses.refusal import disagreement
from modcal_core.measurements.samples import Samples
from modcal_core.robots.chain import Chain

CHAIN = ur10()


@pytest.fixture(scope="module")
def clean() -> Samples:
    return record(12, 90).samples


def named(found: Disagreement | None) -> str:
    assert found is not None
    assert found.remedy
    return found.what


def with_origin(j: int, T: Array) -> Chain:
    origins = CHAIN.origins.copy()
    origins[j] = T
    return CHAIN.with_origins(origins)


def test_a_length_of_the_description(clean: Samples) -> None:
    T = CHAIN.origins[2].copy()
    T[:3, 3] *= 0.7
    said = named(disagreement(clean, with_origin(2, T)))
    assert said.startswith(f"the origin of joint {CHAIN.names[2]} in the URDF looks wrong by")


def test_a_turn_and_an_axis_of_the_description(clean: Samples) -> None:
    T = CHAIN.origins[3].copy()
    T[:3, :3] = T[:3, :3] @ Rotation.from_euler("xyz", [0.7, -0.4, 0.2]).as_matrix()
    assert f"joint {CHAIN.names[3]} in the URDF" in named(disagreement(clean, with_origin(3, T)))
    axes = CHAIN.axes.copy()
    axes[2] = [1.0, 0.0, 0.0]
    said = named(disagreement(clean, replace(CHAIN, axes=axes)))
    assert f"joint {CHAIN.names[2]} looks as if it turned about 0 0 1" in said


def other_module(j: int, degrees: float, shift: tuple[float, float, float]) -> Chain:
    """The description with another link before a joint: turned about x, and longer."""
    turn = se3.transform(Rotation.from_euler("x", degrees, degrees=True).as_matrix(), np.array(shift))
    return with_origin(j, CHAIN.origins[j] @ turn)


@pytest.mark.parametrize("j", [1, 3])
def test_a_link_of_another_length_and_another_turn(clean: Samples, j: int) -> None:
    """Where axes are parallel, the turn alone could stand at any of them."""
    said = named(disagreement(clean, other_module(j, 90.0, (0.1, 0.0, 0.15))))
    assert said.startswith(f"the link before joint {CHAIN.names[j]} is another than in the URDF")
    assert "turned by 90" in said


def test_two_wrong_links_name_none(clean: Samples) -> None:
    two = other_module(1, 90.0, (0.1, 0.0, 0.15))
    origins = two.origins.copy()
    origins[4, :3, 3] += [0.2, 0.1, 0.0]
    said = named(disagreement(clean, two.with_origins(origins)))
    assert "more than one link of the URDF is different" in said


def test_an_arm_that_only_slides_has_no_axis_to_blame() -> None:
    """Orientations that its joints cannot make are no link's fault."""
    names, axes = ("x", "y", "z"), np.eye(3)
    gantry = Chain.build(names, [np.eye(4)] * 4, axes, [False] * 3, [-1.0] * 3, [1.0] * 3)
    rng = np.random.default_rng(0)
    q = rng.uniform(-1.0, 1.0, (60, 3))
    T = np.tile(np.eye(4), (60, 1, 1))
    T[:, :3, :3], T[:, :3, 3] = Rotation.random(60, random_state=0).as_matrix(), q
    assert disagreement(samples_of(gantry, q, T), gantry) is None
