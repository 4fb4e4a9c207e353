"""Simulated travel stays within the speeds and efforts that the URDF states, by MuJoCo's own inverse dynamics."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from modcal_core.geometry.so3 import Array
from modcal_core.robots.acceleration import read_drives
from modcal_core.robots.chain import Chain
from modcal_core.robots.urdf import read_chain
from modcal_core.robots.urdf_inertias import read_inertias
from modcal_nodes.cli.main import run
from modcal_nodes.simulation.program import Program, tour, within_limits
from modcal_nodes.simulation.world import World

ROBOTS = Path(__file__).resolve().parents[2] / "examples" / "robots"


def loads(chain: Chain, text: str, legs: list[tuple[float, Array]]) -> tuple[Array, Array, float]:
    """(largest speed, largest torque, duration): shares of what the URDF states (n,), and seconds."""
    program = Program(np.zeros(chain.n))
    program.reset(0.0, legs)
    step = 0.01
    t = np.arange(0.0, program.end, step)
    q = np.array([program.at(x) for x in t])
    v = np.gradient(q, step, axis=0)
    a = np.gradient(v, step, axis=0)
    world = World(chain, np.random.default_rng(0), 0.0, 0.0, None, None, read_inertias(text, chain))
    drives, torque = read_drives(text, chain), np.empty_like(q)
    for i in range(len(t)):
        world.data.qpos[:], world.data.qvel[:], world.data.qacc[:] = q[i], v[i], a[i]
        mujoco.mj_inverse(world.model, world.data)
        torque[i] = world.data.qfrc_inverse
    return np.abs(v).max(axis=0) / drives.speed, np.abs(torque).max(axis=0) / drives.torque, program.end


@pytest.mark.parametrize("robot", ["ur10", "panda"])
def test_no_leg_asks_more_of_the_drives_than_the_urdf_states(robot: str) -> None:
    text = (ROBOTS / f"{robot}.urdf").read_text()
    chain = read_chain(text)
    legs = tour(chain, 8, 0.5, 0.3, np.random.default_rng(3))
    slowed = within_limits(legs, np.zeros(chain.n), text, chain)
    assert slowed.overloads == ()
    assert [list(q) for _, q in slowed.legs] == [list(q) for _, q in legs]
    before, after = loads(chain, text, legs), loads(chain, text, slowed.legs)
    assert before[0].max() > 1.0
    assert after[0].max() <= 1.0
    assert after[1].max() <= 1.0
    # as slow as needed, no slower: some drive is near what it can do
    assert max(after[0].max(), after[1].max()) > 0.85
    assert before[2] < after[2] < 8.0 * before[2]


def test_what_no_slowness_helps_is_said() -> None:
    text = (ROBOTS / "ur10.urdf").read_text()
    chain = read_chain(text)
    legs = tour(chain, 8, 0.5, 0.3, np.random.default_rng(3))
    said = within_limits(legs, np.zeros(6), text, chain, payload=30.0).overloads[0]
    assert said.startswith("shoulder_lift_joint: gravity takes ")
    assert "of its effort of 330 on the way" in said


def test_limits_accepts_what_simulate_records(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    few = ("-p", "stations=6", "-p", "joint_rate_hz=20", "-p", "tracker_rate_hz=10")
    assert run(["simulate", str(ROBOTS / "ur10.urdf"), "--out", str(tmp_path / "bag"), *few]) == 0
    assert run(["limits", str(tmp_path / "bag")]) == 0
    assert "cannot" not in capfd.readouterr().err
