"""A model of a package is fitted, weighed as the built-in kinds are, and says nothing of what moves otherwise."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from articulation.folding import folding
from articulation.objects import ideal, noisy, real
from finite_differences import assert_jacobian

from modcal_core.articulation import choice, furniture
from modcal_core.articulation.choice import choose
from modcal_core.articulation.fit import fit
from modcal_core.articulation.joint_motion import Kind
from modcal_core.articulation.models import registry
from modcal_core.articulation.models.parametric import ParametricModel, ParametricMotion, PathJoint, ShapeParameter
from modcal_core.articulation.models.revolute import MODEL as REVOLUTE
from modcal_core.articulation.models.revolute import RevoluteJoint
from modcal_core.articulation.track import Track
from modcal_core.errors import BadTable
from modcal_core.geometry.so3 import Array

pytestmark = pytest.mark.slow

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "extending" / "cell_extras" / "folding_door.py"
DEGREE = np.pi / 180.0
# As it was before packages could add anything: kind, reach, with rotations; probabilities and log-likelihood. The first
# is so slow for its noise that 9 of its 60 samples count as a rest, which has no say in the probabilities any more.
BEFORE = [
    ("revolute", 0.05, True, (1.2379255e-08, 0.00042869012, 0.98278912, 0.01678218), 1356.9993401590),
    ("screw", 0.5, False, (1.0777372e-16, 6.6762672e-10, 0.9791709, 0.020829101), 662.8410204884),
]


def example() -> ParametricModel:
    spec = importlib.util.spec_from_file_location("folding_door", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert isinstance(module.MODEL, ParametricModel)
    return module.MODEL


FOLDING = example()


class Circle(ParametricModel):
    """A hinge, as a package would write it, with furniture's own prior of radii."""

    name = "circle"
    parameters = (ShapeParameter("log_radius", *furniture.RADIUS),)
    lower, upper, unit, share = -3.0, 3.0, "rad", 0.3

    def pose(self, values: Array, a: Array) -> Array:
        c, s = np.cos(a), np.sin(a)
        T = np.tile(np.eye(4), (len(a), 1, 1))
        T[:, 0, 0], T[:, 0, 1], T[:, 1, 0], T[:, 1, 1] = c, -s, s, c
        T[:, :2, 3] = np.exp(values[0]) * np.stack([c, s], axis=1)
        return T


def with_models(monkeypatch: pytest.MonkeyPatch, *models: ParametricModel) -> None:
    monkeypatch.setattr(choice, "all_models", lambda: (*registry.BUILT_IN, *models))


@pytest.mark.parametrize(("kind", "reach", "oriented", "probabilities", "log_likelihood"), BEFORE)
def test_without_packages_nothing_has_changed(
    kind: Kind, reach: float, oriented: bool, probabilities: Sequence[float], log_likelihood: float
) -> None:
    rng = np.random.default_rng(4)
    seen = noisy(ideal(kind, np.linspace(0.0, reach, 60), rng, 0.4, 0.08), rng, 1e-3, 0.005)
    found = choose(Track(seen.positions, seen.rotations if oriented else None))
    assert list(found.probabilities) == ["rigid", "prismatic", "revolute", "screw"]
    assert list(found.probabilities.values()) == pytest.approx(list(probabilities), rel=1e-4)
    assert found.fit.log_likelihood == pytest.approx(log_likelihood, rel=1e-6)
    assert list(found.fits) == list(found.probabilities)


def test_derivatives(rng: np.random.Generator) -> None:
    p, R = folding(rng, 0.4, 0.15, 30)
    track = Track(p, R)
    found = fit(track, FOLDING, rng)
    motion = found.motion
    assert isinstance(motion, ParametricMotion)
    a = found.configurations + 0.02 * rng.standard_normal(30)
    a = np.clip(a, 0.01, 1.5)
    both, by_a = motion.expanded(track, a)
    assert_jacobian(
        lambda z: motion.moved(z).residuals(track, a).ravel(), both[:, :, 1:].reshape(-1, motion.size),
        np.zeros(motion.size), 1e-4, 1e-7,
    )  # fmt: skip
    assert_jacobian(lambda b: motion.residuals(track, a + b).ravel(), by_a.reshape(-1, 1), np.zeros(1), 1e-4, 1e-7)
    off = motion.residuals(track, motion.configurations(track))
    for side in (1e-3, -1e-3):  # the nearest configurations are nearest
        assert (motion.residuals(track, motion.configurations(track) + side) ** 2).sum() > (off**2).sum()


def test_a_hinge_that_a_package_writes_weighs_what_the_houses_hinge_weighs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Same likelihood, same prior volume: their odds are those of their shares, but for what Laplace's method leaves."""
    with_models(monkeypatch, Circle())
    rng = np.random.default_rng(1)
    seen = noisy(ideal("revolute", np.linspace(0.0, 1.2, 60), rng, 0.4), rng, 1e-3, 0.3 * DEGREE)
    found = choose(Track(seen.positions, seen.rotations))
    own: float = found.probabilities["circle"]
    log_odds = np.log(own / found.probabilities["revolute"]) - np.log(0.3 / (0.7 * REVOLUTE.share))
    assert abs(log_odds) < 1.0
    mine, hinge = found.fits["circle"], found.fits["revolute"]
    assert isinstance(mine.model, PathJoint)
    assert isinstance(hinge.model, RevoluteJoint)
    assert np.exp(mine.model.values["log_radius"]) == pytest.approx(hinge.model.radius, rel=2e-3)
    assert mine.log_likelihood == pytest.approx(hinge.log_likelihood, abs=0.5)


def test_what_none_of_the_four_kinds_explains_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    with_models(monkeypatch, FOLDING)
    rng = np.random.default_rng(0)
    width, handle = rng.uniform(0.3, 0.55), rng.uniform(0.08, 0.22)
    p, R = folding(rng, width, handle)
    found = choose(Track(p, R))
    assert found.kind == "folding_door"
    assert found.enough
    assert found.probabilities["folding_door"] > 0.95
    assert sum(found.probabilities.values()) == pytest.approx(1.0)
    assert found.fit is found.fits["folding_door"]
    assert isinstance(found.fit.model, PathJoint)
    for name, true in (("log_width", np.log(width)), ("handle_m", handle)):
        assert abs(found.fit.model.values[name] - true) < 3.0 * found.fit.std[name], name
        assert found.fit.std[name] < 0.01
    assert found.why.startswith("folding_door (100 %): it moved ")
    # where it says that it is, it is
    assert np.linalg.norm(found.fit.model.position(found.fit.configurations) - p, axis=1).max() < 5e-3


@pytest.mark.parametrize(("kind", "oriented"), [("prismatic", True), ("revolute", False)])
def test_what_moves_otherwise_is_told_as_before(kind: Kind, oriented: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = real(kind, np.random.default_rng(0))
    rows = np.unique(np.linspace(0, len(seen.a) - 1, 80).round().astype(int))
    track = Track(seen.positions[rows], seen.rotations[rows] if oriented else None)
    with_models(monkeypatch)
    without = choose(track)
    with_models(monkeypatch, FOLDING)
    found = choose(track)
    assert found.kind == without.kind, found.why
    assert found.probabilities["folding_door"] < 0.05


class _Bad(Circle):
    """A model with one fault."""

    __module__ = "bad_extras"

    def __init__(self, fault: str) -> None:
        self.fault = fault

    def pose(self, values: Array, a: Array) -> Array:
        T = super().pose(values, a)
        if self.fault == "raises":
            raise ZeroDivisionError("float division by zero")
        if self.fault == "nan":
            T[-1, 0, 3] = np.nan
        if self.fault == "still":
            T = np.tile(np.eye(4), (len(a), 1, 1))
        if self.fault == "mirror":
            T[:, 2, 2] = -1.0
        return T[:, :3] if self.fault == "shape" else T

    def begin(self, track: Track) -> Sequence[Array]:
        return [np.zeros(3)] if self.fault == "begin" else super().begin(track)


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ("raises", "pose at log_radius = -0.916291: raises ZeroDivisionError (float division by zero)"),
        ("nan", "pose at log_radius = -0.916291: is not finite at a = 3"),
        ("shape", "pose at log_radius = -0.916291: has shape (48, 3, 4), not (48, 4, 4)"),
        ("mirror", "pose at log_radius = -0.916291: is not a rigid transform"),
        ("still", "pose at log_radius = -0.916291: does not move"),
        ("begin", "begin: is not a list of 1 finite numbers each"),
    ],
)
def test_a_faulty_model_is_refused_by_name(fault: str, said: str, rng: np.random.Generator) -> None:
    p, _ = folding(rng, 0.4, 0.15, 30)
    own = _Bad(fault)
    with pytest.raises(BadTable) as error:
        fit(Track(p), own, rng)
    remedy = "fix the package that provides it, or uninstall it"
    assert str(error.value) == f"articulation model circle of package bad_extras, {said}: {remedy}"
