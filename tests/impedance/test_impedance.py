"""The impedance law: what physics says of it, at any gains and any step."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from modcal_core.errors import BadCommand
from modcal_core.geometry.so3 import Array
from modcal_core.impedance.impedance import Gains, Impedance


def some_gains(rng: np.random.Generator) -> Gains:
    size = 10.0 ** rng.uniform(-2, 4, (3, 6))
    return Gains.of(size[0], size[1], size[2], Rotation.random(rng=rng).as_matrix())


def energy(law: Impedance) -> float:
    M, _, K = law.gains.matrices()
    return float(0.5 * law.v @ M @ law.v + 0.5 * law.x @ K @ law.x)


@pytest.mark.slow
@settings(deadline=None)
@given(seed=st.integers(0, 2**32 - 1), h=st.floats(1e-4, 10.0))
def test_left_alone_its_energy_only_falls(seed: int, h: float) -> None:
    rng = np.random.default_rng(seed)
    law = Impedance(some_gains(rng))
    law.x, law.v = rng.normal(size=6), rng.normal(size=6)
    before = energy(law)
    for _ in range(20):
        law.step(np.zeros(6), h)
        assert energy(law) <= before * (1.0 + 1e-9) + 1e-12
        before = energy(law)


def test_it_solves_the_differential_equation(rng: np.random.Generator) -> None:
    """Against another integrator, with an error that falls with the step."""
    gains = Gains.of((10.0, 1.0), (200.0, 10.0), (900.0, 30.0), Rotation.random(rng=rng).as_matrix())
    M, B, K = gains.matrices()
    F = rng.normal(size=6) * [20, 20, 20, 2, 2, 2]

    def rate(t: float, y: Array) -> Array:
        return np.concatenate([y[6:], np.linalg.solve(M, F * np.cos(3.0 * t) - B @ y[6:] - K @ y[:6])])

    exact = solve_ivp(rate, (0.0, 1.0), np.zeros(12), rtol=1e-10, atol=1e-12).y[:6, -1]
    off = []
    for n in (500, 1000, 2000):
        law = Impedance(gains)
        for k in range(n):
            law.step(F * np.cos(3.0 * (k + 1) / n), 1.0 / n)
        off.append(np.abs(law.x - exact).max() / np.abs(exact).max())
    assert off[-1] < 2e-3
    assert off[0] / off[1] == pytest.approx(2.0, rel=0.1)
    assert off[1] / off[2] == pytest.approx(2.0, rel=0.1)


def test_turning_the_task_turns_the_answer(rng: np.random.Generator) -> None:
    R = Rotation.random(rng=rng).as_matrix()
    kinds = {"mass": (9, 8, 7, 3, 2, 1), "damping": (90, 80, 70, 6, 5, 4), "stiffness": (500, 300, 100, 9, 7, 5)}
    plain, turned_ = Impedance(Gains.of(**kinds)), Impedance(Gains.of(**kinds, task=R))
    both = np.kron(np.eye(2), R)
    for _ in range(30):
        F = rng.normal(size=6)
        assert np.allclose(both @ plain.step(F, 0.01), turned_.step(both @ F, 0.01), atol=1e-12)


@pytest.mark.slow
def test_other_gains_come_in_without_a_jump(rng: np.random.Generator) -> None:
    """Of position and of speed; the acceleration changes by less than a hundredth of what a sudden change would do."""
    h, F = 0.004, rng.normal(size=6)
    soft, hard = Gains.of(stiffness=(100.0, 10.0)), Gains.of(stiffness=(3000.0, 200.0))
    jumps = []
    for blend in (0.0, 1.0):
        law = Impedance(soft, blend)
        for _ in range(3000):
            law.step(F, h)
        x, v = law.x, law.v
        law.change(hard)
        law.step(F, h)
        assert np.abs(law.x - x).max() <= np.abs(law.v).max() * h + 1e-15
        jumps.append(np.abs(law.v - v).max())
        for _ in range(5000):
            law.step(F, h)
        assert np.allclose(hard.matrices()[2] @ law.x, F, atol=1e-3)
    assert jumps[1] < 0.01 * jumps[0]


@pytest.mark.parametrize(
    "wrong",
    [
        {"mass": (0.0, 1.0)},
        {"mass": (1.0, -1.0)},
        {"damping": (np.nan, 1.0)},
        {"damping": (0.0, 1.0)},
        {"damping": (1000.0, 0.0)},
        {"stiffness": (-1.0, 1.0)},
        {"stiffness": (1.0, 2.0, 3.0)},
        {"task": 2.0 * np.eye(3)},
    ],
)
def test_gains_that_are_none_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(BadCommand):
        Gains.of(**wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize("turn", [0.5, 1.2, 3.0])
def test_gains_turn_along_with_the_way(turn: float) -> None:
    """A hand that does not turn with a door, led about it: a force along the way leads along it in the end, too."""
    gains = Gains.of((10.0, 10.0, 10.0, 1.0, 1.0, 1.0), (1000.0,) * 3 + (80.0,) * 3, (1000.0, 300.0, 300.0, 20, 20, 20))
    law, steps, along = Impedance(gains), 4000, np.zeros(3)
    for k in range(2 * steps):
        a = turn * min(k / steps, 1.0)
        along = np.array([np.cos(a), np.sin(a), 0.0])
        law.align(along)
        before = law.x
        law.step(np.concatenate([30.0 * along, np.zeros(3)]), 0.004)
        assert np.linalg.norm(law.x - before) < 2e-4  # nothing jumps: 5 cm/s
    assert law.gains.task[:, 0] @ along > np.cos(np.radians(5.0)) - 1e-9
    off = law.x[:3] - (law.x[:3] @ along) * along
    assert law.x[:3] @ along == pytest.approx(0.03, rel=0.03)
    assert np.linalg.norm(off) < 0.25 * 0.03  # 5° of a force on what is three times as soft
