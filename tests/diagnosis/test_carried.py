"""A recorded number that says what the arm carries: its joints deflect by it, as virtual work has it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import record, samples_of, ur10

from modcal_core.loop import calibrate
from modcal_core.measurements.recording import SignalTrack
from modcal_core.measurements.samples import Samples
from modcal_core.robots.kinematics import forward
from modcal_core.robots.mechanism import offset_wrench, payload_wrench

ELBOW = 2
COMPLIANCE = 8e-6  # rad/(N m)


def loaded(topic: str, factor: float = 1.0) -> Samples:
    """The elbow deflects under a mass at the tip that changes from station to station."""
    made = record(5, 120)
    chain, q = ur10(), made.samples.q
    rng = np.random.default_rng(1)
    mass = rng.choice([0.0, 2.0, 5.0], len(q))
    step = np.zeros(6)
    step[ELBOW] = 1e-6
    rise = (forward(chain, q + step)[:, 2, 3] - forward(chain, q - step)[:, 2, 3]) / 2e-6
    actual = q - COMPLIANCE * mass[:, None] * 9.81 * rise[:, None] * (np.arange(6) == ELBOW)
    T = made.world.tool_in_tracker(actual)
    T[:, :3, 3] += 2e-5 * rng.standard_normal((len(q), 3))
    samples = samples_of(chain, q, T)
    return replace(samples, signals=(SignalTrack(f"signal:{topic}", samples.stamps, factor * mass[:, None], topic),))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("topic", "factor", "name", "expected"),
    [("/payload_kg", 1.0, "compliance", COMPLIANCE), ("/load_cell", 9.81, "compliance_per_unit", COMPLIANCE / 9.81)],
)
def test_a_payload_that_is_recorded_loads_the_joints(topic: str, factor: float, name: str, expected: float) -> None:
    report = calibrate(loaded(topic, factor), ur10(), np.random.default_rng(0)).report
    (effect,) = report.effects
    assert (effect.family, effect.place, effect.driver) == ("compliance", "elbow_joint", "load:elbow_joint")
    assert effect.parameters[name][0] == pytest.approx(expected, rel=0.01)  # lengths are off by half a millimetre
    size = report.size_mm("final")
    assert size is not None
    assert size.rms < 1.25 * 2e-2 * np.sqrt(3.0)
    assert not any("no masses" in sentence for sentence in report.story)


def test_the_weight_of_a_mass_beside_the_tip_is_that_of_virtual_work() -> None:
    chain, rng = ur10(), np.random.default_rng(2)
    q, beside = rng.uniform(-2.0, 2.0, (20, 6)), np.array([0.03, -0.05, 0.12])

    def height(postures: np.ndarray) -> np.ndarray:
        T = forward(chain, postures)
        return T[:, 2, 3] + T[:, 2, :3] @ beside

    torque = payload_wrench(chain, q)[:, 5] + np.einsum("d,djn->jn", beside, offset_wrench(chain, q)[:, :, 5])
    for j in range(6):
        step = 1e-6 * (np.arange(6) == j)
        rise = (height(q + step) - height(q - step)) / 2e-6
        assert np.abs(torque[j] + 9.80665 * rise).max() < 1e-7
