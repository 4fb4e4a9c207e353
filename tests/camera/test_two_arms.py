"""A camera on one arm of a robot and a target on the other: one chain from tip to tip, whose root hangs in between."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from camera.bags import JOINT_STATE, START, header, stops
from camera.boards import BOARD, LENS, facing, views
from camera.by_tracker import missed_by_tracker
from camera.scenes import BOARD_ON_TIP, HOME, PANDA

from modcal_core.calibration import Model
from modcal_core.calibration.model import place_model
from modcal_core.calibration.store import Calibration, from_data, to_data
from modcal_core.camera.arm_poses import ImageMoments
from modcal_core.camera.bundle import BoardView
from modcal_core.camera.target_file import target_to_data
from modcal_core.effects.drivers import Drivers, NominalArm
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples
from modcal_core.robot import Robot
from modcal_core.robots.chain import Chain
from modcal_core.robots.kinematics import chain_forward
from modcal_core.robots.mechanism import inverse_batch
from modcal_core.robots.urdf import read_chain
from modcal_core.robots.urdf_write import rerooted
from modcal_msgs_py.images import CLOUD, fill_corners
from modcal_msgs_py.layout import message_class
from modcal_msgs_py.mcap_write import BagWriter
from modcal_nodes.cli.camera_input import arm_between
from modcal_nodes.cli.main import run
from modcal_nodes.simulation.mjcf import World

CAMERA_ON_LEFT = se3.transform(so3.exp([0.02, 0.01, 0.7]), [0.06, 0.02, 0.03])


def two_pandas() -> str:
    """Two Pandas on one torso that face each other, 1.4 m apart, as a URDF."""
    text = PANDA.read_text()
    body = text[text.index(">", text.index("<robot ")) + 1 : text.index("</robot>")]
    arms = "".join(
        f'{body.replace("panda_", f"{side}_")}<joint name="{side}_mount" type="fixed"><origin xyz="{x} 0 0.1" '
        f'rpy="0 0.2 {yaw}"/><parent link="torso"/><child link="{side}_link0"/></joint>'
        for side, x, yaw in (("left", 0.0, 0.0), ("right", 1.4, np.pi))
    )
    return f'<robot name="two"><link name="torso"/>{arms}</robot>'


def test_links_stand_to_each_other_as_before(rng: np.random.Generator) -> None:
    text = two_pandas()
    left, right = (read_chain(text, "torso", f"{side}_link8") for side in ("left", "right"))
    turned = rerooted(text, "left_link8")
    both = read_chain(turned, "left_link8", "right_link8")
    assert both.names == (*left.names[::-1], *right.names)
    assert np.allclose(both.upper, np.r_[left.upper[::-1], right.upper])
    a, b = (rng.uniform(-1.5, 1.5, (20, 7)) for _ in range(2))
    apart = se3.inverse(chain_forward(left, a)) @ chain_forward(right, b)
    assert np.allclose(chain_forward(both, np.c_[a[:, ::-1], b]), apart, atol=1e-12)
    # and back
    again = rerooted(turned, "torso")
    assert np.allclose(chain_forward(read_chain(again, "torso", "left_link8"), a), chain_forward(left, a), atol=1e-12)
    assert rerooted(text, "torso") == text


def postures(chain: Chain, rng: np.random.Generator, count: int) -> np.ndarray:
    """At which the camera on the left arm sees the board on the right one."""
    out = np.empty((0, chain.n))
    while len(out) < count:
        wanted = CAMERA_ON_LEFT @ facing(rng, 2 * count, near=0.35, far=0.6) @ se3.inverse(BOARD_ON_TIP)
        start = np.r_[HOME[::-1], HOME] + 0.3 * rng.normal(size=(2 * count, chain.n))
        found = inverse_batch(chain, wanted, start, tolerance=1e-3)
        out = np.concatenate([out, found.q[found.met]])
    return out[:count]


def test_each_joint_bears_what_it_bears_in_its_own_arm(rng: np.random.Generator) -> None:
    """Weight at every joint of both arms as one chain is that of the arms by themselves, held at the torso."""
    text = two_pandas()
    both, _ = arm_between(text, "left_link8", "right_link8", ())
    arms = [Robot.from_urdf(text, "torso", f"{side}_link8") for side in ("left", "right")]
    q = [rng.uniform(-1.5, 1.5, (12, 7)) for _ in arms]
    together = np.c_[q[0][:, ::-1], q[1]]
    loads = Drivers(samples_of(both.chain, together), NominalArm(both.chain, both.inertias))
    for arm, own, side in zip(arms, q, ("left", "right"), strict=True):
        alone = Drivers(samples_of(arm.chain, own), NominalArm(arm.chain, arm.inertias))
        for name in arm.names:
            assert np.ptp(alone.values(f"load:{name}")) > 0.0 or name.endswith(("joint1", "joint7"))
            assert loads.values(f"load:{name}") == pytest.approx(alone.values(f"load:{name}"), abs=1e-9)
            across = [np.linalg.norm(d.values(f"moment:{name}"), axis=0) for d in (loads, alone)]
            assert across[0] == pytest.approx(across[1], abs=1e-9)
            if side == "right":
                assert loads.values(f"payload:{name}") == pytest.approx(alone.values(f"payload:{name}"), abs=1e-9)
            else:
                assert not loads.values(f"payload:{name}").any()
    model = replace(place_model(both.chain, ("camera",)), arm=NominalArm(both.chain, both.inertias))
    kept = from_data(to_data(Calibration(model, model, model, np.zeros((2, both.chain.n)))))
    again = Drivers(samples_of(both.chain, together), kept.calibrated.arm)
    assert again.gravity == pytest.approx(loads.gravity)


def bag_of_corners(
    folder: Path,
    description: str,
    names: Sequence[str],
    q: Array,
    seen: dict[str, list[BoardView]],
    size: tuple[int, int],
) -> Path:
    """A bag of a robot that stops at each posture, and the corners that detectors publish there, by topic."""
    String, cloud = message_class("std_msgs/msg/String"), message_class(CLOUD)
    field = message_class("sensor_msgs/msg/PointField")
    with BagWriter(folder) as bag:
        bag.write("/robot_description", "std_msgs/msg/String", String(data=description), int(1e9 * START))
        for t, state, k, share in stops(names, q):
            bag.write("/joint_states", JOINT_STATE, state, int(1e9 * t))
            for topic, views_of in seen.items() if share == 0.5 else ():
                empty = cloud(header(t), 0, 0, [], False, 0, 0, np.empty(0, np.uint8), True)
                message = fill_corners(empty, field, replace(views_of[k], stamp=t), size, "camera")
                message.data = np.frombuffer(message.data, np.uint8)
                bag.write(topic, CLOUD, message, int(1e9 * t))
    return folder


@pytest.mark.slow
def test_both_arms_from_a_bag_of_corners_with_a_spring_in_each(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Both arms sag by MuJoCo, each held at the torso; what bends is found in either, and the tool is where it is."""
    text, rng = two_pandas(), np.random.default_rng(12)
    both, _ = arm_between(text, "left_link8", "right_link8", ())
    arms = [Robot.from_urdf(text, "torso", f"{side}_link8") for side in ("left", "right")]
    soft = np.zeros(7)
    soft[1] = 1e-4  # rad/(N m), of the shoulder
    worlds = [
        World(a.chain, rng, 1e-3, 1e-3, None, on_tip, inertias=a.inertias, compliance=soft)
        for a, on_tip in zip(arms, (CAMERA_ON_LEFT, BOARD_ON_TIP), strict=True)
    ]

    def truth(q: Array) -> Array:
        """T_camera_target by both machines."""
        real = q + 2e-5 * rng.standard_normal(q.shape)
        left, right = worlds[0].tool_in_tracker(real[:, 6::-1]), worlds[1].tool_in_tracker(real[:, 7:])
        return np.asarray(se3.inverse(left) @ right)

    q = postures(both.chain, rng, 50)
    seen = views(rng, truth(q), 0.03)
    bag = bag_of_corners(tmp_path / "both", text, both.names, q, {"/board_detector/corners": seen}, LENS.size)
    data = target_to_data(BOARD, (0.21, 0.15))
    data["rulers"] |= {"measured_x_m": 0.21, "measured_y_m": 0.15, "measured_std_m": 5e-5}
    (tmp_path / "target.yaml").write_text(yaml.safe_dump(data))
    call = ["calibrate", str(bag), "--target", str(tmp_path / "target.yaml")]
    call += ["--base", "left_link8", "--tip", "right_link8", "--out", str(tmp_path / "out")]
    assert run(call) == 0
    assert "both arms are calibrated as one chain of 14 joints" in " ".join(capsys.readouterr().out.split())
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["camera"]["decision"] == "apply"
    found = {e["place"]: e for e in report["effects"]}
    assert set(found) == {"left_joint2", "right_joint2"}
    for one in found.values():
        size = one["parameters"]["compliance"]
        assert size["value"] == pytest.approx(1e-4, abs=4.0 * size["std"])
    fresh = postures(both.chain, np.random.default_rng(3), 40)
    tip = CAMERA_ON_LEFT @ truth(fresh) @ se3.inverse(BOARD_ON_TIP)
    urdfs = rerooted(text, "left_link8"), (tmp_path / "out" / "calibrated.urdf").read_text()
    miss = [
        missed_by_tracker(chain_forward(read_chain(one, "left_link8", "right_link8"), fresh), tip, BOARD_ON_TIP[:3, 3])
        for one in urdfs
    ]
    assert miss[1] < 0.25 * miss[0]


def samples_of(chain: Chain, q: np.ndarray) -> Samples:
    """These postures, nothing being read."""
    model = Model(chain, ("camera",), np.eye(4)[None], np.eye(4))
    return ImageMoments().samples(model, q, np.zeros_like(q))
