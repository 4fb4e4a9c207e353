"""The quick equations of serial arms are the plain ones, to rounding."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from calibration.test_linearise import SHIFT, TURN, cell
from cells import record, slider_arm, ur10

from modcal_core.calibration import fit as fitting
from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.calibration.equations import PlainSystem
from modcal_core.calibration.fit import identify
from modcal_core.calibration.kernels import serial
from modcal_core.calibration.kernels.serial import SerialSystem, is_serial
from modcal_core.calibration.model import Model
from modcal_core.calibration.parameters import ordered_candidates
from modcal_core.calibration.structure import choose_parameters, views_of
from modcal_core.measurements.samples import Samples
from modcal_core.robots.chain import Chain

KINDS = [("pose",), ("point",), ("point", "point"), ("pose", "pose", "pose")]


def compare(model: Model, samples: Samples, seed: int) -> None:
    """Both ways at values and weights drawn from a seed, some samples rejected."""
    parameters = ordered_candidates(model.chain, model.frames, views_of(samples))
    rng = np.random.default_rng(seed)
    values = rng.normal(size=len(parameters)) * [TURN if p.turns else SHIFT for p in parameters]
    own = rng.uniform(0.1, 2.0, len(samples)) * (rng.random(len(samples)) > 0.2)
    turned = (own * rng.uniform(0.5, 2.0, len(samples)))[samples.is_pose]
    weight = np.concatenate([np.tile(own, 3), np.tile(turned, 3)])
    assert is_serial(model, samples, parameters)
    plain = PlainSystem(model, parameters, samples, model.drivers(samples))
    quick = SerialSystem(model, parameters, samples)
    a, b = plain.residuals(values), quick.residuals(values)
    assert np.abs(a.position - b.position).max() < 1e-12
    assert np.abs(a.rotation - b.rotation).max(initial=0.0) < 1e-12
    H, g = plain.normal_equations(values, weight)
    H_quick, g_quick = quick.normal_equations(values, weight)
    assert np.abs(H - H_quick).max() < 1e-12 * np.abs(H).max()
    assert np.abs(g - g_quick).max() < 1e-12 * np.abs(g).max()
    assert np.abs(g - quick.gradient(values, weight)).max() < 1e-12 * np.abs(g).max()


@pytest.mark.parametrize("chain", [ur10(), slider_arm()], ids=["ur10", "sliders"])
@pytest.mark.parametrize("kinds", KINDS, ids="-".join)
def test_quick_and_plain_equations_are_one(chain: Chain, kinds: tuple[str, ...]) -> None:
    compare(*cell(chain, kinds), seed=2)


@pytest.mark.parametrize("kinds", KINDS[1:], ids="-".join)
def test_blocks_make_no_difference(kinds: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    """Several blocks of which the last is short; sweeps that are kept, and sweeps that are made again."""
    for kept in (0, 100):
        monkeypatch.setattr(serial, "BLOCK", 7)
        monkeypatch.setattr(serial, "COLUMNS", 3)
        monkeypatch.setattr(serial, "_KEPT", kept)
        compare(*cell(ur10(), kinds), seed=3)


def test_frames_that_share_their_error() -> None:
    model, samples = cell(ur10(), ("pose", "pose", "pose"))
    compare(replace(model, leaders=(0, 1, 0)), samples, seed=4)


def test_orientations_that_are_far_off() -> None:
    model, samples = cell(ur10(), ("pose",))
    about = samples.R[:, :, [1, 2, 0]]  # a third of a turn
    compare(model, replace(samples, R=np.where(np.arange(8)[:, None, None] % 2, about, samples.R)), seed=5)


@pytest.mark.parametrize("kind", ["point", "pose"])
def test_beginning_with_a_few_changes_nothing(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A fit of all samples at once is the same fit, and its covariance the same to a thousandth."""
    made = record(6, 1500, kind)
    start = fit_cell(ur10(), made.samples, Cell()).model
    parameters = choose_parameters(start, views_of(made.samples)).parameters
    begun = identify(start, made.samples, parameters)
    monkeypatch.setattr(fitting, "_MANY", 10**9)
    at_once = identify(start, made.samples, parameters)
    assert np.abs((begun.values - at_once.values) / at_once.std).max() < 1e-3
    assert np.abs(begun.std / at_once.std - 1.0).max() < 1e-3
    assert np.abs(begun.weights - at_once.weights).max() < 1e-3
