"""What changes from one recording to the next is measured, with an honest deviation, and named; nothing else is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cells import NOISE_M, NOISE_RAD, Recorded, record, samples_of, ur10

from modcal_core.calibration.store import Calibration, from_data, to_data
from modcal_core.errors import BadTable
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.loop import calibrate
from modcal_core.measurements.samples import Samples
from modcal_core.online.drift import WEEK, Drift, change_since, drift

STILL = np.zeros(6)
SEEDS = (3, 4, 5)


def calibrated(seed: int, kind: str = "pose") -> tuple[Recorded, Calibration]:
    cell = record(seed, 80, kind)
    found = calibrate(cell.samples, ur10(), np.random.default_rng(0), look_for_effects=False).calibration
    return cell, found


def later(
    cell: Recorded, seed: int, weeks: float, base: Array = STILL, tool: Array = STILL, zero: Array = STILL,
    kind: str = "pose",
) -> Samples:  # fmt: skip
    """Readings of the same arm so many weeks later; base, tool: by which twist they have moved; zero: [rad]."""
    rng = np.random.default_rng(1000 + seed)
    q = rng.uniform(-np.pi, np.pi, (80, 6))
    T = cell.world.tool_in_tracker(q + zero)
    at = cell.world.T_tracker_base
    T = at @ se3.exp(base) @ se3.inverse(at) @ T @ se3.exp(tool)
    T[:, :3, 3] += NOISE_M * rng.standard_normal((80, 3))
    T[:, :3, :3] = T[:, :3, :3] @ so3.exp(NOISE_RAD * rng.standard_normal((80, 3)))
    made = samples_of(ur10(), q, T, kind)
    return replace(made, stamps=made.stamps + weeks * WEEK)


def in_all(found: Drift) -> tuple[Array, Array]:
    """Change along each named direction over the whole time, and its standard deviation."""
    span = found.until - found.since
    return span * found.size, span * found.size_std


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_what_has_moved_is_named_and_measured(seed: int) -> None:
    cell, reference = calibrated(seed)
    moved = {
        ("base", "z"): ({"base": np.array([0, 0, 3e-4, 0, 0, 0])}, [3e-4]),
        ("base", "x y z"): ({"base": np.array([2e-4, -2e-4, 1e-4, 0, 0, 0])}, [2e-4, -2e-4, 1e-4]),
        ("tool", "y"): ({"tool": np.array([0, -3e-4, 0, 0, 0, 0])}, [-3e-4]),
        ("elbow_joint", "zero"): ({"zero": np.array([0, 0, 4e-4, 0, 0, 0])}, [4e-4]),
    }
    for (place, directions), (how, size) in moved.items():
        found = drift(reference, [change_since(reference, later(cell, seed, 10.0, **how))])
        assert found.named is not None
        assert (found.named.place, " ".join(found.named.directions)) == (place, directions)
        change, std = in_all(found)
        np.testing.assert_array_less(np.abs(change - size), 3.0 * std)
        assert std.max() < 3e-5


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["pose", "point"])
def test_an_arm_that_stands_still_is_left_alone(kind: str) -> None:
    squares = []
    for seed in SEEDS:
        cell, reference = calibrated(seed, kind)
        changes = [change_since(reference, later(cell, seed + 10 * w, w, kind=kind)) for w in (3, 7)]
        found = drift(reference, changes)
        assert found.named is None
        assert found.recordings == 3
        squares.append(np.mean((found.rate / found.std) ** 2))
    # deviations that were too small would make this larger; each is the mean of about thirty squares
    assert np.mean(squares) < 1.8


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_a_slow_drift_is_a_line_through_many_recordings(seed: int) -> None:
    cell, reference = calibrated(seed)
    rise = np.array([0.0, 0.0, 2e-5, 0.0, 0.0, 0.0])
    weeks = (2.0, 5.0, 6.0, 12.0)
    changes = [change_since(reference, later(cell, seed + int(w), w, base=w * rise)) for w in weeks]
    found = drift(reference, changes)
    assert found.named is not None
    assert found.named.name == "base z"
    assert abs(WEEK * found.size[0] - 2e-5) < 3.0 * WEEK * found.size_std[0]
    alone = drift(reference, changes[-1:])
    assert found.size_std[0] < alone.size_std[0]
    assert "shoulder_lift_joint y" in found.same_as  # which is the same motion


@pytest.mark.slow
def test_a_base_that_is_set_up_anew_says_nothing_and_hides_nothing() -> None:
    cell, reference = calibrated(SEEDS[0])
    away = np.array([0.4, -0.2, 0.1, 0.0, 0.0, 0.7])
    still = change_since(reference, later(cell, 1, 10.0, base=away))
    assert still.base
    assert still.tool
    assert drift(reference, [still]).named is None
    # of base and tool, which were found again, this recording says nothing: as many directions are open as they have
    stood = change_since(reference, later(cell, 1, 10.0))
    assert not stood.base
    assert (np.linalg.eigvalsh(stood.covariance) > 0.1).sum() == 0
    assert (np.linalg.eigvalsh(still.covariance) > 0.1).sum() == 12
    found = drift(reference, [change_since(reference, later(cell, 2, 10.0, base=away, zero=4e-4 * np.eye(6)[2]))])
    assert found.named is not None
    assert found.named.name == "elbow_joint zero"
    change, std = in_all(found)
    assert abs(change[0] - 4e-4) < 3.0 * std[0]


@pytest.mark.slow
def test_recordings_that_scatter_widen_the_line() -> None:
    """Something that comes and goes is no drift: sessions that differ by more than their noise are believed less."""
    cell, reference = calibrated(SEEDS[0])
    there = np.array([0.0, 0.0, 2e-4, 0.0, 0.0, 0.0])
    calm = [change_since(reference, later(cell, w, w)) for w in (1, 2, 3, 4)]
    restless = [change_since(reference, later(cell, w, w, base=there * (-1) ** w)) for w in (1, 2, 3, 4)]
    assert drift(reference, restless).std[0] > 3.0 * drift(reference, calm).std[0]


@pytest.mark.slow
def test_a_calibration_that_was_read_again_gives_the_same() -> None:
    cell, reference = calibrated(SEEDS[0])
    samples = later(cell, 1, 1.0, base=np.array([0, 0, 3e-4, 0, 0, 0]))
    one = drift(reference, [change_since(reference, samples)])
    again = from_data(to_data(reference))
    other = drift(again, [change_since(again, samples)])
    np.testing.assert_allclose(one.rate, other.rate, rtol=1e-6, atol=1e-15)


def test_what_cannot_be_compared_is_refused() -> None:
    cell, reference = calibrated(SEEDS[0])
    samples = later(cell, 1, 1.0)
    with pytest.raises(BadTable, match="needs a serial arm"):
        change_since(replace(reference, uncertainty=None), samples)
    with pytest.raises(BadTable, match="needs a recording after"):
        drift(reference, [])
    with pytest.raises(BadTable, match="needs a recording after"):
        drift(reference, [change_since(reference, later(cell, 1, 0.0))])
