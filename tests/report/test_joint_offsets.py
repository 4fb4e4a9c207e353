"""Joint offsets: what was put into an arm is found, whatever base and tool are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import samples_of, ur10

from modcal_core.calibration.model import place_model
from modcal_core.geometry import se3, so3
from modcal_core.report.joint_offsets import joint_offsets

OFFSETS = np.radians([0.3, -0.2, 0.15, 0.1, -0.05, 0.4])


@pytest.mark.parametrize("kind", ["pose", "point"])
def test_offsets_that_were_put_in_are_found(kind: str) -> None:
    """The first and the last joint's are turns of base and tool, and a point of the tool shows no turn of it."""
    chain = ur10()
    turned = se3.transform(so3.exp(np.c_[np.zeros((6, 2)), OFFSETS]))
    origins = np.array(chain.origins)
    origins[:-1] = origins[:-1] @ turned
    start = place_model(chain, ("tracker",))
    T_tip_tool = se3.exp([0.05, 0.03, 0.12, 0.4, -0.3, 0.2])
    base = se3.exp([1.0, -2.0, 0.3, 0.5, 0.1, -1.0])[None]
    model = replace(start, chain=chain.with_origins(origins), T_tip_tool=T_tip_tool, T_frame_base=base)
    q = np.random.default_rng(1).uniform(-2.5, 2.5, (60, 6))
    found = joint_offsets(model, samples_of(chain, q, model.predict(q), kind))
    assert found is not None
    assert [name for name, _ in found.turning] == list(chain.names[1:5])
    assert [value for _, value in found.turning] == pytest.approx(np.degrees(OFFSETS[1:5]), abs=2e-3)
    assert not found.sliding
    assert found.left_mm < 0.01 * found.nominal_mm


def test_an_arm_that_is_nominal_has_none() -> None:
    model = place_model(ur10(), ("tracker",))
    q = np.random.default_rng(1).uniform(-2.5, 2.5, (20, 6))
    found = joint_offsets(model, samples_of(ur10(), q, model.predict(q)))
    assert found is not None
    assert [value for _, value in found.turning] == pytest.approx([0.0] * 4, abs=1e-9)
