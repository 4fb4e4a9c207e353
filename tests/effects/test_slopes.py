"""How shapes change with the settings that are fitted, where a shape says it itself."""

from __future__ import annotations

import numpy as np
import pytest

from modcal_core.effects.shapes import KINDS, Shape

SETTINGS = {"cycles": 7.3, "tau": 40.0, "since": -1.0, "beta": 0.3, "scale": 2.0, "lag": 0.0}
STATED = [(kind, name) for kind, known in KINDS.items() for name in known.slopes]


@pytest.mark.parametrize(("kind", "name"), STATED)
def test_they_are_those_of_small_steps(kind: str, name: str) -> None:
    x = np.linspace(-3.0, 2.0, 60)
    shape = Shape(kind, SETTINGS)
    step = 1e-6 * SETTINGS[name]
    ahead, behind = (shape.with_settings({name: SETTINGS[name] + d}).basis(x) for d in (step, -step))
    slope = KINDS[kind].slopes[name](x, shape.settings, shape.basis(x))
    np.testing.assert_allclose(slope, (ahead - behind) / (2.0 * step), atol=1e-6 * np.abs(slope).max())


def test_waves_say_theirs() -> None:
    assert {("sine", "cycles"), ("double", "cycles")} <= set(STATED)
