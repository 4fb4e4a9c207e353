"""Corners from a CSV: of one camera or several, of sheets and bodies, and the command that takes them."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from camera.boards import BOARD
from camera.bodies import BODY_ON_TIP, SIZE, BodyScene, Faults, body_scene, bundle_to_data, icosahedron, measured
from camera.by_tracker import missed_by_tracker
from camera.scenes import PANDA

from modcal_core.camera.bundle import ARUCO_GRID, PrintedTarget
from modcal_core.camera.lens import Lens
from modcal_core.errors import BadTable, NotEnoughData
from modcal_core.report.camera import camera_info
from modcal_core.robots.mechanism import forward
from modcal_core.robots.urdf import read_chain
from modcal_nodes.cli.main import run
from modcal_nodes.vision.corner_table import camera_key, read_corner_tables
from modcal_nodes.vision.images import read_camera_info

JOINTS = ("a", "b")
BODY = icosahedron()


def tables(where: Path, rows: str, joints: str = "image,a,b\n1,0,0.5\n2,1,0\n") -> tuple[Path, Path]:
    (where / "corners.csv").write_text(rows)
    (where / "joints.csv").write_text(joints)
    return where / "corners.csv", where / "joints.csv"


def test_cameras_markers_and_middles(tmp_path: Path) -> None:
    rows = (
        "camera,image,marker,corner,u,v,sigma\n"
        "left,1,3,,10,20,0.3\nright,1,3,,11,21,\nleft,1,5,2,30,40,\nleft,2,3,,50,60,\n"
        "left,2,77,,1,1,\n"  # of another body
        "right,2,4,,1,2,\nright,2,4,,3,4,\nright,2,6,,5,6,\n"  # one marker at two places
    )
    found = read_corner_tables(*tables(tmp_path, rows), JOINTS, BODY, {"left": (100, 80), "": (64, 48)})
    assert list(found) == ["left", "right"]
    left, right = found["left"], found["right"]
    assert (left.size, right.size) == ((100, 80), (64, 48))
    assert [v.name for v in left.views] == ["1", "2"]
    assert list(left.views[0].ids) == [BODY.point(3, None), BODY.point(5, 2)]
    assert np.allclose(left.views[0].cov[:, 0, 0], [0.09, 0.01])
    assert np.allclose(left.q, [[0.0, 0.5], [1.0, 0.0]])
    assert left.notes == (f"1 rows of {tmp_path / 'corners.csv'} are of markers that the target does not have.",)
    assert list(right.views[1].ids) == [BODY.point(6, None)]
    assert right.notes == ("Image 2 has a marker twice, which is left out of it.",)


def test_rows_of_corners_that_were_not_seen(tmp_path: Path) -> None:
    rows = "image,id,u,v\n1,3,10,20\n1,4,,\n1,5,NaN,nan\n2,3,30,40\n"
    (found,) = read_corner_tables(*tables(tmp_path, rows), JOINTS, BOARD, {"": (100, 80)}).values()
    assert [list(v.ids) for v in found.views] == [[3], [3]]
    with pytest.raises(BadTable, match="line 2: holds a number that is not finite"):
        read_corner_tables(*tables(tmp_path, "image,id,u,v\n1,4,nan,20\n"), JOINTS, BOARD, {"": (100, 80)})
    with pytest.raises(NotEnoughData, match="holds no corner"):
        read_corner_tables(*tables(tmp_path, "image,id,u,v\n1,4,nan,nan\n"), JOINTS, BOARD, {"": (100, 80)})


def test_joints_may_stand_in_the_table_of_corners(tmp_path: Path) -> None:
    rows = "image,marker,u,v,a,b,width,height\n1,3,10,20,0,0.5,100,80\n1,4,10,20,0,0.5,100,80\n2,3,1,2,1,0,100,80\n"
    file, _ = tables(tmp_path, rows)
    (found,) = read_corner_tables(file, file, JOINTS, BODY).values()
    assert np.allclose(found.q, [[0.0, 0.5], [1.0, 0.0]])
    file, _ = tables(tmp_path, rows.replace("4,10,20,0,", "4,10,20,0.1,"))
    with pytest.raises(BadTable, match="two rows for image 1 that differ"):
        read_corner_tables(file, file, JOINTS, BODY)


def test_corners_of_sheets_by_number_or_by_marker(tmp_path: Path) -> None:
    grid = PrintedTarget(ARUCO_GRID, 3, 2, 0.03, 0.01, "DICT_5X5_100", 10)
    rows = "image,marker,corner,u,v\n1,11,3,10,20\n1,12,0,1,2\n1,99,0,1,2\n"
    (found,) = read_corner_tables(*tables(tmp_path, rows), JOINTS, grid, {"": (100, 80)}).values()
    assert list(found.views[0].ids) == [7, 8]
    rows = "image,id,u,v\n1,7,10,20\n2,8,1,2\n"
    (found,) = read_corner_tables(*tables(tmp_path, rows), JOINTS, BOARD, {"": (100, 80)}).values()
    assert [list(v.ids) for v in found.views] == [[7], [8]]


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ("image,u,v\n1,2,3\n", "has no column id"),
        ("image,id,u,v\n1,24,2,3\n", "the target has 0 to 23"),
        ("image,id,u,v\n1,3,2,3\n1,3,5,6\n", "has a corner twice"),
        ("image,marker,corner,u,v\n1,3,0,2,3\n", "has a marker, which a charuco has none of"),
        ("image,id,corner,u,v\n1,3,4,2,3\n", "has corner 4 of a marker"),
        ("image,id,u,v,width,height\n1,3,2,3,100,80\n1,4,2,3,100,81\n", "images of 100 × 80 and of 100 × 81"),
        ("image,id,u,v\n1,3,2,nan\n", "not finite"),
        ("image,id,u,v\n1,three,2,3\n", "cannot be read"),
        ("image,id,u,v\n1,3,2,3\n", "how large the images are"),
    ],
)  # fmt: skip
def test_tables_that_are_refused(tmp_path: Path, rows: str, said: str) -> None:
    sizes = None if "how large" in said or "width" in rows else {"": (100, 80)}
    with pytest.raises(BadTable, match=said):
        read_corner_tables(*tables(tmp_path, rows), JOINTS, BOARD, sizes)


def test_images_without_joints_are_no_images(tmp_path: Path) -> None:
    with pytest.raises(NotEnoughData, match="names no image that the table of joints has"):
        read_corner_tables(*tables(tmp_path, "image,id,u,v\n5,3,2,3\n"), JOINTS, BOARD, {"": (100, 80)})


def written(where: Path, s: BodyScene) -> list[str]:
    """Files of a cell, and the command's arguments."""
    lines = ["camera,image,marker,u,v,width,height"]
    numbers = [m.id for m in s.drawing.markers]
    for one in s.images:
        for v in one.views:
            for point, (x, y) in zip(v.ids, v.pixels, strict=True):
                lines.append(f"{one.name},{v.name},{numbers[point // 5]},{x:.4f},{y:.4f},{SIZE[0]},{SIZE[1]}")
            lines.append(f"{one.name},{v.name},41,100,100,{SIZE[0]},{SIZE[1]}")  # on the other arm
    (where / "corners.csv").write_text("\n".join(lines) + "\n")
    header = ",".join(["image", *s.chain.names])
    rows = [",".join([f"{i}", *map(repr, map(float, q))]) for i, q in enumerate(s.q)]
    (where / "joints.csv").write_text("\n".join([header, *rows]) + "\n")
    (where / "target.yaml").write_text(yaml.safe_dump(bundle_to_data(s.drawing)))
    lens = Lens(s.lenses[1].values, s.lenses[1].size)
    (where / "second.yaml").write_text(yaml.safe_dump(camera_info(lens)))
    files = {"--images": "corners.csv", "--joints": "joints.csv", "--target": "target.yaml"}
    return [
        *("calibrate", "--urdf", str(PANDA), "--tip", "panda_link8", "--geometry-only"),
        *(text for option, name in files.items() for text in (option, str(where / name))),
    ]


@pytest.mark.slow
def test_a_csv_of_two_cameras_to_a_calibrated_arm(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """From a table of middles of markers, those of another arm's body among them, to the files."""
    s = body_scene(5, 60, 2, Faults(late=1), drawing=measured(icosahedron()))
    given = written(tmp_path, s)
    info = f"camera_2={tmp_path / 'second.yaml'}"
    assert run([*given, "--camera-info", info, "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().out
    assert "Also camera_2, on the world: body of 20 markers" in said
    assert "are of markers that the target does not have" in said
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["camera"]["decision"] == "apply"
    assert report["camera"]["sheet"] == {}
    assert len(report["camera"]["body"]["markers"]) == 20
    assert "Markers on the body" in (tmp_path / "out" / "report.html").read_text()
    assert (tmp_path / "out" / "camera_2.yaml").exists()
    # the arm by itself, against MuJoCo
    q = np.random.default_rng(0).uniform(s.q.min(0), s.q.max(0), (200, 7))
    urdfs = PANDA.read_text(), (tmp_path / "out" / "calibrated.urdf").read_text()
    arms = [forward(read_chain(text, tip="panda_link8"), q) for text in urdfs]
    miss = [missed_by_tracker(T, s.tip(q), BODY_ON_TIP[:3, 3]) for T in arms]
    assert miss[1] < 3e-4 < 1e-3 < miss[0]
    assert run([*given, "--camera-info", f"third={tmp_path / 'second.yaml'}"]) == 2
    assert "names no camera of these images" in capsys.readouterr().err


def test_what_two_cameras_saw_may_stand_in_one_row(tmp_path: Path) -> None:
    header = "image,marker,corner,left_u,left_v,right_u,right_v"  # a row a corner, columns of cameras
    rows = f"{header}\n1,3,1,10,20,11,21\n1,5,2,30,40,nan,nan\n2,3,0,,,50,60\n2,4,1,0,0,-1,-1\n"
    left, right = read_corner_tables(*tables(tmp_path, rows), JOINTS, BODY, {"": (100, 80)}).values()
    assert [list(v.ids) for v in left.views] == [[BODY.point(3, 1), BODY.point(5, 2)]]
    assert [list(v.ids) for v in right.views] == [[BODY.point(3, 1)], [BODY.point(3, 0)]]
    assert np.allclose(right.views[1].pixels, [[50.0, 60.0]])
    assert np.allclose(right.q, [[0.0, 0.5], [1.0, 0.0]])


def test_a_row_a_posture_with_columns_of_cameras_markers_and_corners(tmp_path: Path) -> None:
    """Joints in the same rows, semicolons, no names of images: a row is one."""
    rows = (
        "a;b;cam1_marker3_corner0_u;cam1_marker3_corner0_v;cam2_m5_c2_u;cam2_m5_c2_v;tracker_x;tracker_y;tracker_z\n"
        "0;0.5;10;20;11;21;1;2;3\n1;0;NaN;NaN;50;60;1;2;3\n"
    )
    file, _ = tables(tmp_path, rows)
    found = read_corner_tables(file, file, JOINTS, BODY, {"1": (100, 80), "2": (64, 48)})
    assert list(found) == ["cam1", "cam2"]
    assert [v.name for v in found["cam2"].views] == ["1", "2"]
    assert list(found["cam2"].views[1].ids) == [BODY.point(5, 2)]
    assert np.allclose(found["cam2"].q, [[0.0, 0.5], [1.0, 0.0]])
    assert len(found["cam1"].views) == 1
    (sheet,) = read_corner_tables(
        *tables(tmp_path, "p3_u,p3_v,p4_u,p4_v\n1,2,3,4\n5,6,7,8\n", "a,b\n0,0\n1,0\n"), JOINTS, BOARD, {"": (9, 9)}
    ).values()
    assert [list(v.ids) for v in sheet.views] == [[3, 4], [3, 4]]
    with pytest.raises(BadTable, match="has 1 rows and no column image"):
        read_corner_tables(*tables(tmp_path, "p3_u,p3_v\n1,2\n", "a,b\n0,0\n1,0\n"), JOINTS, BOARD, {"": (9, 9)})


@pytest.mark.parametrize(
    ("header", "said"),
    [
        ("image,marker3_u,marker3_v,tag3_u,tag3_v", "of the same corner"),
        ("image,left_u,left_v", "does not say which corner it is of"),
        ("image,left_x,left_y,left_z", "has no column u"),
    ],
)
def test_wide_tables_that_nobody_can_read(tmp_path: Path, header: str, said: str) -> None:
    row = ",".join(["1", *("5" for _ in header.split(",")[1:])])
    with pytest.raises(BadTable, match=said):
        read_corner_tables(*tables(tmp_path, f"{header}\n{row}\n"), JOINTS, BODY, {"": (100, 80)})


def test_a_camera_is_known_by_its_name_however_it_is_written(tmp_path: Path) -> None:
    """cam1 of the columns, Cam_1 of the command; one size is enough for a camera that is stated, the other is named."""
    rows = "image,cam1_corner0_u,cam1_corner0_v,cam2_corner0_u,cam2_corner0_v\n1,2,3,4,5\n2,2,4,4,6\n"
    sizes = {camera_key("Cam_1"): (100, 80), camera_key("camera 2"): (60, 50)}
    found = read_corner_tables(*tables(tmp_path, rows), JOINTS, BOARD, sizes)
    assert {name: one.size for name, one in found.items()} == {"cam1": (100, 80), "cam2": (60, 50)}
    assert camera_key("left") == camera_key("LEFT") != camera_key("right")
    with pytest.raises(BadTable, match="images of cam2 are: .*--camera-info cam2=FILE"):
        read_corner_tables(*tables(tmp_path, rows), JOINTS, BOARD, {camera_key("cam1"): (100, 80)})


def test_joints_in_degrees_say_so_in_their_columns(tmp_path: Path) -> None:
    """A unit in brackets counts; without one degrees are refused, with how to say it."""
    rows = "image,id,u,v\n1,0,2,3\n"
    corners, joints = tables(tmp_path, rows)
    joints.write_text("image,a [deg],b (rad)\n1,180,0.5\n")
    found = read_corner_tables(corners, joints, ("a", "b"), BOARD, {"": (100, 80)})[""]
    assert found.q == pytest.approx(np.array([[np.pi, 0.5]]))
    joints.write_text("image,a,b\n1,180,0.5\n")
    with pytest.raises(BadTable, match=r"name the columns a \[deg\]"):
        read_corner_tables(corners, joints, ("a", "b"), BOARD, {"": (100, 80)})


def test_intrinsics_as_opencv_writes_them(tmp_path: Path) -> None:
    """With its tags for matrices, and the first line of its older versions, which is no YAML."""
    K, d = (
        np.array([[800.0, 0.0, 320.0], [0.0, 801.0, 240.0], [0.0, 0.0, 1.0]]),
        np.array([[-0.1, 0.02, 0.0, 1e-4, 0.0]]),
    )
    file = tmp_path / "lens.yaml"
    store = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE)
    for name, value in (("image_width", 640), ("image_height", 480), ("camera_matrix", K)):
        store.write(name, value)
    store.write("distortion_coefficients", d)
    store.release()
    lens = read_camera_info(file)
    assert lens.size == (640, 480)
    assert pytest.approx(K) == lens.K
    assert lens.values[4:] == pytest.approx(d[0])
    older = tmp_path / "older.yaml"
    older.write_text(file.read_text().replace("%YAML 1.2", "%YAML:1.0"))
    assert (read_camera_info(older).values == lens.values).all()


def test_lenses_as_other_tools_write_them(tmp_path: Path) -> None:
    """Trailing zeros, Kalibr's file, a rational polynomial; more than eight coefficients are refused."""
    K = [[605.9, 0.0, 637.6], [0.0, 605.8, 364.5], [0.0, 0.0, 1.0]]

    def info(model: str, d: list[float]) -> Path:
        file = tmp_path / "lens.yaml"
        matrices = {"camera_matrix": {"data": np.ravel(K).tolist()}, "distortion_coefficients": {"data": d}}
        file.write_text(
            yaml.safe_dump({"image_width": 1280, "image_height": 720, "distortion_model": model, **matrices})
        )
        return file

    five = [-0.03, 0.035, -1e-4, 2e-4, -0.012]
    for model, more in (("plumb_bob", 3), ("rational_polynomial", 3), ("plumb_bob", 9)):
        assert read_camera_info(info(model, [*five, *[0.0] * more])).values[4:] == pytest.approx(five)
    rational = read_camera_info(info("rational_polynomial", [0.5, -2.7, 0.0, 0.0, 1.6, 0.4, -2.6, 1.5]))
    assert rational.below.tolist() == [0.4, -2.6, 1.5]
    written = camera_info(rational)
    assert (written["distortion_model"], written["distortion_coefficients"]["cols"]) == ("rational_polynomial", 8)
    with pytest.raises(BadTable, match="has model rational_polynomial with 12 coefficients: give plumb_bob or"):
        read_camera_info(info("rational_polynomial", [*five, *[0.1] * 7]))
    kalibr = {
        "camera_model": "pinhole",
        "distortion_model": "radtan",
        "distortion_coeffs": five[:4],
        "intrinsics": [605.9, 605.8, 637.6, 364.5],
        "resolution": [1280, 720],
    }
    (tmp_path / "camchain.yaml").write_text(yaml.safe_dump({"cam0": kalibr}))
    lens = read_camera_info(tmp_path / "camchain.yaml")
    assert pytest.approx(np.array(K)) == lens.K
    assert lens.values[4:8] == pytest.approx(five[:4])
    (tmp_path / "camchain.yaml").write_text(yaml.safe_dump({"cam0": kalibr, "cam1": kalibr}))
    with pytest.raises(BadTable, match="has 2 cameras"):
        read_camera_info(tmp_path / "camchain.yaml")
