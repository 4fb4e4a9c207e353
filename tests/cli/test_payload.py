"""``modcal payload``: what MuJoCo's arms carry, by torques with wrong constants, dry friction and noise."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from cli.conftest import Refused
from robots.random_arms import Mujoco, inertial_link

from modcal_core.errors import BadRecording
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.recording import JointTrack, Recording
from modcal_core.robots.bodies import Payload
from modcal_core.robots.chain import Chain
from modcal_core.robots.urdf import read_chain
from modcal_core.robots.urdf_inertias import read_inertias
from modcal_core.robots.weighing import Stands, weigh
from modcal_msgs_py.recording_write import write_recording
from modcal_nodes.cli.main import run

ROBOTS = Path(__file__).resolve().parents[2] / "examples" / "robots"
ARMS = ("ur10", "xarm7", "iiwa14")


def loaded(text: str, chain: Chain, mass: float, centre: Array) -> str:
    """The description with one more link, bolted to the tip."""
    link = inertial_link("load", mass, centre, (0.0, 0.0, 0.0), (0.01, 0.01, 0.01, 0.0, 0.0, 0.0))
    bolt = f'<joint name="bolt" type="fixed"><parent link="{chain.tip}"/><child link="load"/></joint>'
    return text.replace("</robot>", link + bolt + "</robot>")


class Drives:
    """Torque constants that are off by 5 %, dry friction that holds a part of the torque at rest, and noise."""

    def __init__(self, joints: int, rng: np.random.Generator) -> None:
        self.factor = 1.0 + 0.05 * rng.standard_normal(joints)
        self.friction, self.rng = rng.uniform(0.2, 2.0, joints), rng

    def reported(self, truth: Mujoco, q: Array, side: Array) -> Array:
        held = np.array([truth.torque(x, 0.0 * x, 0.0 * x) for x in q])
        held += self.friction * side * self.rng.uniform(0.5, 1.0, q.shape)
        return (held + self.rng.normal(0.0, 0.05, q.shape)) / self.factor


def drawn(arm: str, seed: int) -> tuple[str, Chain, float, Array, Drives, np.random.Generator]:
    rng = np.random.default_rng(seed)
    text = (ROBOTS / f"{arm}.urdf").read_text()
    chain = read_chain(text)
    return text, chain, float(rng.uniform(0.5, 5.0)), rng.normal(0.0, 0.06, 3), Drives(chain.n, rng), rng


def postures(chain: Chain, count: int, rng: np.random.Generator) -> Array:
    return rng.uniform(np.maximum(chain.lower, -2.0), np.minimum(chain.upper, 2.0), (count, chain.n))


@pytest.mark.parametrize("arm", ARMS)
def test_payloads_lie_within_what_is_stated(arm: str) -> None:
    """Ten of each arm, alone and beside a recording without the payload: as sure as is stated."""
    off = []
    for seed in range(10):
        text, chain, mass, centre, drives, rng = drawn(arm, seed)
        stands = []
        for full, text_of in ((True, loaded(text, chain, mass, centre)), (False, text)):
            q = postures(chain, 15, rng)
            side = np.sign(rng.standard_normal(q.shape))
            stands.append(Stands(q, drives.reported(Mujoco(text_of, chain), q, side), side, full))
        for used in (stands, stands[:1]):
            found = weigh(chain, read_inertias(text, chain), used)
            off.append(np.r_[found.mass - mass, found.centre - centre] / found.std)
            if used is stands:
                assert found.std[0] < 0.1 * mass
    assert np.abs(off).max() < 4.0
    assert np.mean(np.abs(off) > 3.0) < 0.02
    assert np.sqrt(np.mean(np.square(off[::2]))) > 0.3


@pytest.mark.parametrize("arm", ARMS)
def test_efforts_that_hold_no_such_arm_are_refused(arm: str) -> None:
    """Currents in place of torques, torques of the other sign, one joint of the other sign; alone and beside a bag."""
    text, chain, mass, centre, drives, rng = drawn(arm, 1)
    one = np.where(np.arange(chain.n) == 1, -1.0, 1.0)
    stands = []
    for full, text_of in ((True, loaded(text, chain, mass, centre)), (False, text)):
        q = postures(chain, 15, rng)
        side = np.sign(rng.standard_normal(q.shape))
        stands.append(Stands(q, drives.reported(Mujoco(text_of, chain), q, side), side, full))
    for factor in (0.1, -1.0, one):
        for used in (stands, stands[:1]):
            told = [Stands(s.q, factor * s.effort, s.side, s.loaded) for s in used]
            with pytest.raises(
                BadRecording, match="holds the links of the robot description|check their sign and unit"
            ):
                weigh(chain, read_inertias(text, chain), told)


def recorded(text: str, chain: Chain, truth: Mujoco, drives: Drives | None, rng: np.random.Generator) -> Recording:
    """Joint states at 50 Hz of an arm that goes from posture to posture and stands for a second in each."""
    stops = postures(chain, 14, rng)
    ramp = np.linspace(0.0, 1.0, 50)[:, None]
    parts = [stops[:1].repeat(50, axis=0)]
    for a, b in pairwise(stops):
        parts += [a + ramp * (b - a), b[None].repeat(60, axis=0)]
    q = np.concatenate(parts)
    side = np.sign(np.diff(q, axis=0, prepend=q[:1]))
    for k in range(1, len(q)):
        side[k] = np.where(side[k] == 0.0, side[k - 1], side[k])
    efforts = np.full_like(q, np.nan) if drives is None else drives.reported(truth, q, side)
    t = 1.7e9 + 0.02 * np.arange(len(q))
    return Recording((JointTrack(chain.names, t, q, np.full_like(q, np.nan), efforts, t),), robot_description=text)


def test_two_bags(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    text, chain, mass, centre, drives, rng = drawn("ur10", 3)
    write_recording(
        recorded(text, chain, Mujoco(loaded(text, chain, mass, centre), chain), drives, rng), tmp_path / "a"
    )
    write_recording(recorded(text, chain, Mujoco(text, chain), drives, rng), tmp_path / "b")
    assert run(["payload", str(tmp_path / "a"), "--without", str(tmp_path / "b"), "--json"]) == 0
    data = json.loads(capfd.readouterr().out)
    assert data["mass_kg"] == pytest.approx(mass, abs=3.0 * data["mass_std_kg"])
    assert (np.abs(data["centre_m"] - centre) < 3.0 * np.array(data["centre_std_m"])).all()
    assert Payload.checked(data["mass_kg"], data["centre_m"]).mass < 1.1 * mass
    assert run(["payload", str(tmp_path / "b")]) == 0
    assert "cannot be told from nothing" in capfd.readouterr().out


def test_what_is_refused(tmp_path: Path, refused: Refused) -> None:
    text, chain, _, _, _, rng = drawn("ur10", 0)
    silent = recorded(text, chain, Mujoco(text, chain), None, rng)
    write_recording(silent, tmp_path / "silent")
    refused(["payload", str(tmp_path / "silent")], "joint states: report no effort")
    track = silent.joints[0]
    rows = slice(0, 300)
    few = JointTrack(
        track.names, *(x[rows] for x in (track.stamps, track.position, track.velocity, track.position, track.received))
    )
    write_recording(Recording((few,), robot_description=text), tmp_path / "few")
    refused(["payload", str(tmp_path / "few")], "3 postures at rest with the payload, 6 are needed")
