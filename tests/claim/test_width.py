"""A fit that is held to usual errors, of an arm of which one link is not usual."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from cells import samples_of

from modcal_core.loop import calibrate
from modcal_core.robots import read_chain

HERE = Path(__file__).parent
CHAIN = read_chain((HERE.parents[1] / "examples" / "robots" / "iiwa14.urdf").read_text(encoding="utf-8"))


def test_no_socket_is_wrong_because_a_link_is_far_off() -> None:
    """Simulated: from the nominal arm a robust fit leaves out all that lay in the first socket, and fits the rest."""
    frame, q = np.split(np.loadtxt(HERE / "one_link_far.csv", delimiter=",", skiprows=1), [1], axis=1)
    samples = None
    for k in range(4):
        own = q[frame[:, 0] == k]
        one = samples_of(CHAIN, own, np.tile(np.eye(4), (len(own), 1, 1)), "point", f"socket_{k}")
        samples = one if samples is None else samples.followed_by(one)
    assert samples is not None
    samples = replace(samples, sockets=samples.frames)
    found = calibrate(samples, CHAIN, np.random.default_rng(0), look_for_effects=False)
    assert found.report.rejected == 0
