"""A held box: pose and size within their own error bars, in the frame that is named, and what is open is said."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from instruments.gripper import NAMES, Gripper, Held, holding
from nodes.processes import beside
from sensor_msgs.msg import Range

from modcal_core.calibration.store import Calibration
from modcal_core.errors import BadTable, NotEnoughData
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.held_box import FACES, Scan, measure_box
from modcal_msgs_py.readings import set_seconds
from modcal_nodes.cli.main import run
from modcal_nodes.ros.lifecycle import interface

pytestmark = pytest.mark.slow

SIZE = np.array([0.12, 0.08, 0.05])
STACK = [0.7, -0.3, 0.1, 0.02, 0.01, 0.5, 0.8658]


def scanned(T: Array, rng: np.random.Generator, each: int = 4) -> Scan:
    """Sensors around the box that look at points of its faces from outside, askew."""
    rays, lengths, faces = [], [], []
    for number, face in enumerate(FACES):
        normal = np.zeros(3)
        normal[number // 2] = 1.0 if number % 2 else -1.0
        for _ in range(each):
            on = rng.uniform(-0.45, 0.45, 3) * SIZE
            on[number // 2] = normal[number // 2] * SIZE[number // 2] / 2.0
            out = normal + rng.uniform(-0.3, 0.3, 3)
            start = on + rng.uniform(0.05, 0.2) * out
            way = T[:3, :3] @ (on - start)
            lengths.append(float(np.linalg.norm(way)))
            rays.append(np.r_[T[:3, :3] @ start + T[:3, 3], way / lengths[-1]])
            faces.append(face)
    return Scan([f"s{i}" for i in range(len(faces))], np.array(rays), np.array(lengths), faces, 1e-4)


def part(scan: Scan, keep: Any) -> Scan:
    rows = np.arange(len(scan.faces))[keep]
    names, faces = [scan.names[i] for i in rows], [scan.faces[i] for i in rows]
    return replace(scan, names=names, rays=scan.rays[rows], lengths=scan.lengths[rows], faces=faces)


def longer(scan: Scan, metres: float) -> Scan:
    return replace(scan, lengths=scan.lengths + np.r_[np.zeros(5), metres, np.zeros(len(scan.lengths) - 6)])


def test_exact_points_give_the_box_itself_and_a_known_size_stands_for_a_face() -> None:
    T = se3.exp([0.1, -0.2, 0.3, 0.4, 0.5, -0.6])
    scan = scanned(T, np.random.default_rng(2))
    seen = part(scan, [f != "-z" for f in scan.faces])
    for box in (measure_box(scan), measure_box(seen, [np.nan, np.nan, SIZE[2]])):
        assert np.abs(box.T_frame_box - T).max() < 1e-7
        assert np.abs(box.size - SIZE).max() < 1e-7
    assert box.std[8] == 0.0
    with pytest.raises(NotEnoughData, match="box, size along z: only one of its two faces was hit"):
        measure_box(seen)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda s: replace(s, faces=["top", *s.faces[1:]]), "face 'top': is not a face of a box"),
        (lambda s: replace(s, lengths=s.lengths * np.nan), "rays on the box: a length is not positive or not finite"),
        (lambda s: replace(s, rays=2.0 * s.rays), "rays on the box: a direction does not have length one"),
        (lambda s: part(s, slice(8, None)), "box, axis x: neither of its faces was hit"),
        (lambda s: part(s, slice(None, None, 4)), "6 rays on the box leave open"),
        (lambda s: longer(s, 0.002), "cannot tell: they leave .* the rest fits without s5: check"),
        (lambda s: replace(s, rays=np.c_[s.rays[:, :3], s.rays[:, 3:]] + _aside(len(s.faces))), "s4 on the box: meets"),
    ],
)
def test_what_cannot_be_measured_is_refused(change: Callable[[Scan], Scan], said: str) -> None:
    with pytest.raises((BadTable, NotEnoughData), match=said):
        measure_box(change(scanned(np.eye(4), np.random.default_rng(4))))


def _aside(count: int) -> Array:
    """A ray on the face +x that passes the box's edge, in its plane."""
    out = np.zeros((count, 6))
    out[4, 2] = 0.1
    return out


@pytest.fixture(scope="module")
def gripper(tmp_path_factory: pytest.TempPathFactory) -> tuple[Gripper, Path]:
    """Sensors with noise, bias and mounting errors in MuJoCo, and the folder of their calibration."""
    folder = tmp_path_factory.mktemp("gripper")
    made = Gripper(2)
    made.calibrating(folder / "bag")
    assert run(["calibrate", str(folder / "bag"), "--geometry-only", "--out", str(folder / "calibration")]) == 0
    return made, folder


def measured(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, Any]:
    capsys.readouterr()
    code = run(["measure-object", *map(str, words), "--json"])
    return code, json.loads(capsys.readouterr().out or "null")


def off(held: Held, found: Any) -> Array:
    """(shift, turn, size) of what was found in the tracked target from the truth, along the box's axes, (9,)."""
    gap = se3.inverse(held.T_target_box) @ se3.from_pose([*found["position_m"], *found["quaternion"]])
    return np.r_[gap[:3, 3], so3.log(gap[:3, :3]), np.array(found["size_m"]) - held.size]


def test_boxes_of_mujoco_lie_within_three_sigma_and_land_on_the_stack(
    gripper: tuple[Gripper, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made, folder = gripper
    boxes = [made.hold() for _ in range(8)]
    holding(tmp_path / "held", boxes)
    place = ["--stack", *STACK, "--stack-mm", "1", "--turn", "20", "--corner"]
    of = (folder / "calibration", tmp_path / "held")
    code, in_tool = measured(capsys, *of, "--frame", "tool")
    assert (code, in_tool["frame"]) == (0, "tool")
    errors = np.array([off(b, f) for b, f in zip(boxes, in_tool["boxes"], strict=True)])
    std = [np.sqrt(np.diag(f["covariance_of_shift_turn_size"])) for f in in_tool["boxes"]]
    assert np.mean(np.abs(errors / std) < 3.0) >= 0.97
    assert np.median(np.linalg.norm(errors[:, :3], axis=1)) < 1e-4

    code, in_tip = measured(capsys, *of, *place)
    assert (code, in_tip["frame"]) == (0, "tool0")
    calibration = Calibration.load(folder / "calibration")
    for held, tip, tool in zip(boxes, in_tip["boxes"], in_tool["boxes"], strict=True):
        T_tip_box = se3.from_pose([*tip["position_m"], *tip["quaternion"]])
        T_tool_box = se3.from_pose([*tool["position_m"], *tool["quaternion"]])
        assert np.abs(calibration.T_tip_tool @ T_tool_box - T_tip_box).max() < 1e-5
        # where the true box stands when the tip is where it was told to be; the target is where the calibration has it
        put = tip["placing"]
        assert put["frame"] == "tool0"
        T_base_tip = se3.from_pose([*put["position_m"], *put["quaternion"]])
        T_stack_box = se3.inverse(se3.from_pose(STACK)) @ T_base_tip @ calibration.T_tip_tool @ held.T_target_box
        corners = T_stack_box[:3, :3] @ (held.size / 2.0 * np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T).T
        corners = so3.exp([0.0, 0.0, -np.radians(20.0)]) @ (corners + T_stack_box[:3, 3:])
        lowest = corners[:, np.argsort(corners[2])[:4]]
        assert np.abs(lowest[:, np.argmin(lowest[:2].sum(axis=0))]).max() < 5e-4
        assert 1e-3 < np.sqrt(put["covariance"][0][0]) < 1.1e-3


def test_a_table_of_ranges_becomes_a_bag_and_what_missed_the_box_is_named(
    gripper: tuple[Gripper, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    made, folder = gripper
    monkeypatch.chdir(tmp_path)
    good, bad = made.hold(), made.hold()
    bad.lengths[5] = np.nan  # one of three on its face
    bad.lengths[6] += 4e-3
    boxes = [good, bad, good]
    rows = [
        ",".join([f"{3 * i}", *("" if np.isnan(x) else f"{1e3 * x:.4f}" for x in b.lengths)])
        for i, b in enumerate(boxes)
    ]
    Path("ranges.csv").write_text("\n".join(["time [s]," + ",".join(f"{name} [mm]" for name in NAMES), *rows]))
    urdf = str(Path(__file__).resolve().parents[2] / "examples" / "robots" / "ur10.urdf")
    assert run(["import", "ranges.csv", "--urdf", urdf, "--out", "bag"]) == 0
    code, found = measured(capsys, folder / "calibration", "bag", "--frame", "tool")
    assert code == 3
    assert np.abs(off(good, found["boxes"][0])[:3]).max() < 3e-4
    assert "cannot tell: they leave" in found["boxes"][1]["cannot_tell"]
    assert "laser_6 read nothing" in found["boxes"][1]["cannot_tell"]


@pytest.mark.dds
def test_the_corrector_measures_what_is_held(gripper: tuple[Gripper, Path]) -> None:
    made, folder = gripper
    held = made.hold()
    kind = interface("MeasureObject")
    with beside(folder, "corrector", calibration=folder / "calibration", target="tool") as (_, node, wait):
        publisher = node.create_publisher(Range, "gripper/range", 100)

        def speak() -> None:
            for name, length in zip(NAMES, held.lengths, strict=True):
                message = Range(range=float(length))
                message.header.frame_id = name
                set_seconds(message.header.stamp, 1e-9 * node.get_clock().now().nanoseconds)
                publisher.publish(message)

        node.create_timer(0.05, speak)
        client = node.create_client(kind, "corrector/measure_object")
        wait(client.service_is_ready, 60.0)

        def asked(**fields: Any) -> Any:
            request = kind.Request(seconds=60.0, **fields)  # the machine may be busy; the box stays
            answer = client.call_async(request)
            wait(answer.done, 60.0)
            return answer.result()

        wait(lambda: asked().done, 60.0)
        answer = asked(place=True)
        assert answer.done, answer.message
        assert answer.frame == answer.box.header.frame_id == "tool"
        assert answer.placing.header.frame_id == "base_link"
        at, turn = answer.box.pose.pose.position, answer.box.pose.pose.orientation
        found = {"position_m": [at.x, at.y, at.z], "quaternion": [turn.x, turn.y, turn.z, turn.w],
                 "size_m": [answer.size.x, answer.size.y, answer.size.z]}  # fmt: skip
        assert np.abs(off(held, found) / np.sqrt(np.diag(np.reshape(answer.covariance, (9, 9))))).max() < 4.0
        refused = asked(faces=["laser_99=-x"])
        assert not refused.done
        assert "sensor 'laser_99': is not calibrated" in refused.message
