"""Forward kinematics, Jacobians and inverse kinematics, against Pinocchio and SciPy."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from cells import ur10
from scipy.optimize import least_squares
from timing import Row, pair_ms

from modcal_core.geometry import se3
from modcal_core.robots.inverse import inverse
from modcal_core.robots.kinematics import forward, spatial_jacobian
from modcal_core.robots.urdf import read_chain

ROOT = Path(__file__).resolve().parents[2]
POSTURES = 10_000


def rows() -> Iterator[Row]:
    """Ours are batched; Pinocchio is called posture by posture, as its Python users do."""
    urdf = (ROOT / "examples" / "robots" / "ur10.urdf").read_text()
    model = pin.buildModelFromXML(urdf)
    data, frame = model.createData(), model.getFrameId("tool0")
    chain = read_chain(urdf)
    q = np.random.default_rng(0).uniform(-3, 3, (POSTURES, 6))
    last = model.joints[model.njoints - 1].id

    def poses() -> Any:
        out = np.empty((len(q), 4, 4))
        for i, posture in enumerate(q):
            pin.framesForwardKinematics(model, data, posture)
            out[i] = data.oMf[frame].homogeneous
        return out

    def jacobians() -> Any:
        out = np.empty((len(q), 6, 6))
        for i, posture in enumerate(q):
            pin.computeJointJacobians(model, data, posture)
            out[i] = pin.getJointJacobian(model, data, last, pin.WORLD)
        return out

    assert np.abs(poses() - forward(chain, q)).max() < 1e-12
    assert np.abs(jacobians() - spatial_jacobian(chain, q)).max() < 1e-12
    ours, other = pair_ms(lambda: forward(chain, q), poses, 7, 3)
    yield Row("kinematics", f"FK, {POSTURES} postures", ours, "Pinocchio in a loop", other)
    ours, other = pair_ms(lambda: spatial_jacobian(chain, q), jacobians, 7, 3)
    yield Row("kinematics", f"Jacobian, {POSTURES} postures", ours, "Pinocchio in a loop", other)

    chain, near = ur10(), np.array([0.3, -1.2, 1.4, -0.8, 1.1, 0.2])
    T = forward(chain, near)

    def gap(x: Any) -> Any:
        return se3.log(se3.inverse(forward(chain, x)) @ T)

    def peer() -> Any:
        return least_squares(gap, near + 0.01, xtol=1e-15, ftol=1e-15, gtol=1e-15).x

    assert np.abs(peer() - inverse(chain, T, near + 0.01)).max() < 1e-7
    ours, other = pair_ms(lambda: inverse(chain, T, near + 0.01), peer, 25, 10)
    yield Row("kinematics", "IK, from nearby", ours, "SciPy least_squares", other)
