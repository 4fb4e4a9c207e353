"""What is weighed beside an anchor is what is weighed anew, as long as the fit is near it; else there is a new one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from calibration.test_identify import fit_all
from cells import record, ur10

from modcal_core.calibration.fit import Fit
from modcal_core.diagnosis.anchor import Anchor
from modcal_core.diagnosis.evidence import Scanner
from modcal_core.diagnosis.space import by_component
from modcal_core.effects.drivers import Drivers
from modcal_core.effects.effect import Effect, columns
from modcal_core.effects.registry import candidates
from modcal_core.effects.shapes import Shape

CHAIN = ur10()
SAMPLES = record(3, 60, "pose").samples


@pytest.fixture(scope="module")
def scene() -> tuple[Fit, Drivers, list[Effect]]:
    """A fit of geometry, its samples, and some candidates of several kinds."""
    fit = fit_all(CHAIN, SAMPLES)
    drivers = fit.model.drivers(SAMPLES)
    return fit, drivers, list(candidates(drivers))[::40]


def with_some(fit: Fit, effects: list[Effect], which: list[int]) -> Fit:
    """The fit with some of the candidates in its model, at nothing: it bends no columns."""
    linear = [e for e in effects if not e.refined]
    chosen = tuple(linear[i].started(np.zeros(len(columns(linear[i], fit.model.drivers(SAMPLES))))) for i in which)
    return replace(fit, model=fit.model.with_effects(chosen))


@pytest.mark.parametrize(("before", "after"), [([], [0, 2]), ([0, 2, 4], [0]), ([0, 2], [2, 4, 5])])
def test_effects_come_and_go(scene: tuple[Fit, Drivers, list[Effect]], before: list[int], after: list[int]) -> None:
    """Shares, amplitudes and freedom are those of rows made anew."""
    fit, drivers, effects = scene
    one, other = with_some(fit, effects, before), with_some(fit, effects, after)
    assert len(one.model.effects) != len(other.model.effects)
    beside, anew = Scanner(effects, drivers), Scanner(effects, drivers)
    beside.evidence(one)
    seen, expected = beside.evidence(other), anew.evidence(other)
    assert beside.space_of(other).changes
    assert not anew.space_of(other).changes
    np.testing.assert_allclose(seen.explained, expected.explained, atol=1e-8)
    assert seen.freedom == expected.freedom
    for effect in effects[::60]:
        np.testing.assert_allclose(
            beside.amplitudes(other, effect), anew.amplitudes(other, effect), rtol=1e-4, atol=1e-9
        )


def test_of_the_next_fit_only_what_is_new_is_made(scene: tuple[Fit, Drivers, list[Effect]]) -> None:
    """What came before stays, though a wave beside it is fitted to other cycles; what is projected out is the same."""
    fit, drivers, effects = scene
    line, other, _ = with_some(fit, effects, [0, 2, 5]).model.effects
    wave = next(e for e in candidates(drivers) if e.shape.kind == "sine").started(np.full(2, 1e-6))
    turned = wave.with_values(wave.values * np.array([1.0, 1.0, 1.01]))
    first, then, back = (
        replace(fit, model=fit.model.with_effects(some))
        for some in ((wave, line), (turned, line, other), (turned, other))
    )
    anchor = Anchor.of(fit, drivers)
    before = anchor.beside(first, drivers).changes  # type: ignore[union-attr]
    after = anchor.beside(then, drivers)
    assert after is not None
    assert after.changes[0] is before[0]
    assert [part.Q.shape[2] for part in after.changes] == [1, 1, 3]
    v = np.random.default_rng(1).normal(size=(after.rows, len(drivers)))
    for now in (then, back):
        seen, anew = (a.beside(now, drivers) for a in (anchor, Anchor.of(fit, drivers)))
        one, two = (
            sum(part.sign * (part.Q @ np.einsum("cNp,cN->p", part.Q, v)) for part in space.changes)  # type: ignore[union-attr]
            for space in (seen, anew)
        )
        np.testing.assert_allclose(one, two, atol=1e-8 * np.abs(v).max())


def test_functions_that_reach_to_no_sample_are_left_out(scene: tuple[Fit, Drivers, list[Effect]]) -> None:
    """Of a curve over far more than the joint's range; what it leaves is what least squares leave, also when it goes."""
    fit, drivers, effects = scene
    line, _, _ = with_some(fit, effects, [0, 2, 5]).model.effects
    elbow = CHAIN.names[2]
    shape = Shape("spline", {"count": 24, "low": -9.0, "high": 9.0})
    curve = Effect("gear_curve", elbow, "axis", f"position:{elbow}", shape).started(np.zeros(24))
    whole, bare = (replace(fit, model=fit.model.with_effects(some)) for some in ((line, curve), (line,)))
    anchor = Anchor.of(whole, drivers)
    basis = shape.basis(drivers.values(curve.driver))
    nothing = int((basis == 0.0).all(axis=1).sum())
    assert nothing > 5
    assert anchor.factor.columns == len(fit.parameters) + 25
    assert anchor.space.Q.shape[2] <= anchor.factor.columns - nothing
    kept = [terms for terms, row in zip(columns(curve, drivers), basis, strict=True) if row.any()]
    left = anchor.space.view.moved_by(kept[0])
    along = by_component(left[None], anchor.space.view)[0] * anchor.space.weight[: anchor.space.rows]
    Q = anchor.space.parts[0].Q
    remains = along - Q @ np.einsum("cNp,cN->p", Q, along)
    assert np.abs(remains).max() < 1e-3 * np.abs(along).max()
    beside, anew = anchor.beside(bare, drivers), Anchor.of(bare, drivers).space
    assert beside is not None
    v = np.random.default_rng(2).normal(size=(beside.rows, len(drivers)))
    one, two = (
        sum(part.sign * (part.Q @ np.einsum("cNp,cN->p", part.Q, v)) for part in space.parts)
        for space in (beside, anew)
    )
    np.testing.assert_allclose(one, two, atol=1e-6 * np.abs(v).max())
