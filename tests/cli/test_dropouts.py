"""Bags of ordinary cells: what says nothing is left out and counted; conventions on import; bags that are read in pieces."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from cells import record, ur10
from cli.conftest import Refused
from cli.recordings import START, URDF, streams
from msgs import bag_forms as forms
from msgs.bag_forms import Cell, Message
from scipy.spatial.transform import Rotation

from modcal_core.errors import BadRecording
from modcal_core.geometry import se3
from modcal_core.measurements.recording import Recording, SignalTrack
from modcal_core.preprocess import Prepared, prepare, prepare_pieces
from modcal_msgs_py import mcap_read
from modcal_msgs_py.layout import jazzy
from modcal_msgs_py.mcap_read import read_pieces, read_recording
from modcal_msgs_py.recording_write import write_recording
from modcal_nodes.cli.main import run

pytestmark = pytest.mark.slow

OBJECT = "<robot name='cup'><link name='cup'/></robot>"
GEOMETRY = ["--geometry-only"]


@pytest.fixture(scope="module")
def c() -> Cell:
    return forms.cell(60)


def calibrated(bag: Path, *options: str) -> Any:
    assert run(["calibrate", str(bag), "--geometry-only", *options, "--out", str(bag.parent / "out")]) == 0
    return json.loads((bag.parent / "out" / "report.json").read_text())


def plain(c: Cell) -> list[Message]:
    return [*forms.joints(c), *forms.described(c), *forms.readings(c)]


def test_everything_that_happens_in_a_cell_at_once(c: Cell, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Dropped, counted and said, and the result is that of the same bag without these messages."""
    q, poses = c.q.copy(), c.poses.copy()
    q[11, 3] = np.nan
    poses[20] = np.nan
    poses[30] = 0.0
    messages = plain(Cell(c.stamps, c.names, q, poses, c.urdf))
    topic, kind, message, ns = messages[5]
    messages[5] = topic, kind, bytes(jazzy().serialize_cdr(message, kind))[:-30], ns
    messages += [("/joint_states", forms.JOINT_STATE, forms.joint_state(ns, ["finger"], []), ns) for ns in c.stamps]
    messages.append(forms.text("/robot_description", OBJECT, c.stamps[9]))
    report = calibrated(forms.write(tmp_path / "bag", messages))
    dropped = report["recording"]["dropped"]
    assert dropped["joint states without a finite position"] == 1
    assert dropped["readings that are not finite"] == 1
    assert dropped["readings without a target (a quaternion of zeros)"] == 1
    assert dropped["messages: it holds names without positions"] == 60
    assert dropped["messages: they are not of type sensor_msgs/msg/JointState"] == 1
    said = " ".join(capfd.readouterr().out.split())
    for words in ("in 1 of 59 messages", "without a target", "names without positions", "2 different contents"):
        assert words in said
    gone = np.isin(np.arange(60), (5, 11, 20, 30))
    rest = Cell([t for t, g in zip(c.stamps, gone, strict=True) if not g], c.names, c.q[~gone], c.poses[~gone], c.urdf)
    clean = calibrated(forms.write(tmp_path / "clean" / "bag", plain(rest)))
    assert report["recording"]["stations"] == clean["recording"]["stations"] == 56
    assert report["error_mm"] == clean["error_mm"]


def test_too_little_left_is_refused_with_how_much(c: Cell, tmp_path: Path, refused: Refused) -> None:
    poses = c.poses.copy()
    poses[5:] = 0.0
    bag = forms.write(tmp_path / "bag", plain(Cell(c.stamps, c.names, c.q, poses, c.urdf)))
    said = "5 stations.*left out: 55 readings without a target"
    refused(["calibrate", str(bag), "--geometry-only", "--out", str(tmp_path / "out")], said)


def test_roles_are_stated_by_option_or_cell_file(c: Cell, tmp_path: Path) -> None:
    """Two candidates: no choice is made; stated, both ways give the same."""
    moved = se3.exp([0.3, 0.0, 0.1, 0.0, 0.2, 0.0])
    other = forms.readings(c, "/other/pose", change=lambda T: moved @ T, frame="other")
    bag = forms.write(
        tmp_path / "bag", [*forms.joints(c), *forms.described(c), *forms.readings(c, "/vrpn/tool/pose"), *other]
    )
    assert run(["calibrate", str(bag), *GEOMETRY, "--out", str(tmp_path / "out")]) == 2
    assert not (tmp_path / "out").exists()
    named = ["--topic", "tracker/pose=/vrpn/tool/pose", "--ignore", "/other/pose"]
    by_option = calibrated(bag, *named)
    cell_file = tmp_path / "cell.yaml"
    cell_file.write_text("topics: {tracker/pose: /vrpn/tool/pose}\nignore: [/other/pose]\n")
    assert calibrated(bag, "--cell", str(cell_file))["error_mm"] == by_option["error_mm"]
    arguments = ["evaluate", str(tmp_path / "out"), str(bag), *named, "--out", str(tmp_path / "evaluated")]
    assert run(arguments) == 0


def test_a_pose_that_was_computed_is_never_taken_by_its_type(c: Cell, tmp_path: Path, refused: Refused) -> None:
    """A name that tells nothing, and a frame that is no link: it is told by how well the model reproduces it."""
    from cells import ur10

    from modcal_core.robots.kinematics import chain_forward
    from modcal_core.robots.urdf import read_chain

    T = chain_forward(read_chain(c.urdf, None, "tool0", frozenset(ur10().names)), c.q)
    computed = Cell(c.stamps, c.names, c.q, se3.to_pose(T), c.urdf)
    bag = forms.write(
        tmp_path / "bag", [*forms.joints(c), *forms.described(c), *forms.readings(computed, "/arm/state", frame="cell")]
    )
    said = "topic /arm/state: was taken as the tracker's topic, as the only candidate; but.*computed from the joints"
    refused(["calibrate", str(bag), *GEOMETRY, "--out", str(tmp_path / "out")], said)
    stated = calibrated(bag, "--topic", "tracker/pose=/arm/state")
    assert stated["status"] == "open"


def test_an_instrument_on_the_tool_is_found_to_be_inverse(c: Cell, tmp_path: Path) -> None:
    seen = forms.readings(c, "/camera/target", forms.TRANSFORM, se3.inverse)
    report = calibrated(forms.write(tmp_path / "bag", [*forms.joints(c), *forms.described(c), *seen]))
    assert report["convention"] == "pose inverted"
    assert report["error_mm"]["final"]["rms"] < 0.5


def test_the_makers_hash_is_kept_or_asked_for(c: Cell, tmp_path: Path) -> None:
    bag = forms.write(tmp_path / "bag", plain(c))
    calibrated(bag)
    text = (tmp_path / "out" / "kinematics.yaml").read_text()
    assert text.startswith("# No hash: ")
    assert "hash: calib_1" not in text
    (tmp_path / "factory.yaml").write_text(text + "  hash: calib_12788084448423163542\n")
    calibrated(bag, "--factory-kinematics", str(tmp_path / "factory.yaml"))
    again = (tmp_path / "out" / "kinematics.yaml").read_text()
    assert (
        again
        == text.partition("kinematics:")[1] + text.partition("kinematics:")[2] + "  hash: calib_12788084448423163542\n"
    )


NAMES = ur10().names


def table(folder: Path, sequence: str = "xyz") -> None:
    """60 postures of an arm with the pose of its tool, Euler angles in degrees."""
    samples = record(1, 60).samples
    angles = Rotation.from_matrix(samples.R).as_euler(sequence, degrees=True)
    header = ",".join((*NAMES, *"xyzabc"))
    rows = np.c_[samples.q, 1e3 * samples.reading, angles]
    np.savetxt(folder / "table.csv", rows, delimiter=",", header=header, comments="")


def imported(folder: Path, **euler: str) -> int:
    stated = {"columns": ["a", "b", "c"], "sequence": "xyz", "unit": "deg", **euler}
    mapping = {
        "tables": [
            {
                "files": "table.csv",
                "time": {"order": {"period_s": 10}},
                "joints": {"unit": "rad", "columns": {name: name for name in NAMES}},
                "pose": {"frame": "t", "unit": "mm", "position": ["x", "y", "z"], "euler": stated},
            }
        ]
    }
    (folder / "mapping.yaml").write_text(yaml.safe_dump(mapping))
    return run(["import", str(folder / "mapping.yaml"), "--urdf", str(URDF), "--out", str(folder / "bag")])


@pytest.mark.parametrize(
    ("stated", "said"),
    [
        ({"sequence": "XYZ"}, "composed as XYZ about moving axes .* look like xyz about fixed axes"),
        ({"sequence": "ZYX"}, ""),  # turning about moving axes in the reverse order: other angles, another rotation
        ({"unit": "rad"}, "they look like degrees"),
    ],
)
def test_a_wrong_statement_is_refused(
    stated: dict[str, str], said: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    import re

    table(tmp_path)
    assert imported(tmp_path, **stated) == 2
    line = capfd.readouterr().err
    assert re.search(said, line), line
    assert not (tmp_path / "bag").exists()


def test_a_right_one_is_written_and_keeps_that_it_has_no_clock(tmp_path: Path) -> None:
    table(tmp_path)
    assert imported(tmp_path) == 0
    assert not read_recording(tmp_path / "bag").has_clock


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of an hour's fifth, with a temperature beside it."""
    recording = streams(200)
    t = np.arange(START, START + recording.duration, 2.0)
    warmth = SignalTrack("temperature:forearm_link", t, 20.0 + 0.01 * (t - START)[:, None], "/temperature")
    folder = tmp_path_factory.mktemp("long") / "bag"
    write_recording(replace(recording, signals=(warmth,)), folder)
    return folder


def prepared_in(bag: Path, most: int | None) -> tuple[Prepared, int]:
    pieces = list(read_pieces(bag, most))
    return prepare_pieces(pieces, ur10()), len(pieces)


def test_pieces_give_the_stations_of_the_whole(bag: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = prepare(read_recording(bag), ur10()).samples
    joint_states = len(read_recording(bag).joints[0].stamps)
    monkeypatch.setattr(mcap_read, "OVERLAP", 12.0)
    prepared, count = prepared_in(bag, joint_states // 7)
    assert count > 4
    pieces = prepared.samples
    assert len(pieces) == len(whole) == 200
    # stations that stand where pieces meet are found once; their edges lie as they lay to a message
    assert np.abs(pieces.stamps - whole.stamps).max() < 0.1
    assert np.abs(pieces.q - whole.q).max() < 1e-9
    assert np.abs(pieces.reading - whole.reading).max() < 1e-5
    assert np.array_equal(pieces.approach[1:], whole.approach[1:])
    assert len(np.unique(pieces.station)) == 200
    (warmth,), (known,) = pieces.signals, whole.signals
    assert np.array_equal(warmth.stamps, known.stamps)
    assert np.array_equal(warmth.values, known.values)


def test_nothing_is_cut_where_a_clock_was_set_back() -> None:
    recording = streams(60)
    assert mcap_read._border(recording) is not None
    joints = recording.joints[0]
    later = joints.stamps > np.median(joints.stamps)
    back = replace(recording, joints=(replace(joints, stamps=joints.stamps - 3600.0 * later),))
    assert mcap_read._border(back) is None


def test_a_piece_without_a_station_is_passed_over(bag: Path) -> None:
    (whole,) = read_pieces(bag, None)
    blind = replace(whole, recording=replace(whole.recording, readings=()))
    both = prepare_pieces([blind, whole], ur10())
    assert len(both.samples) == 200
    assert any("left out" in note for note in both.notes)
    with pytest.raises(BadRecording, match="tracker"):
        prepare_pieces([blind, blind], ur10())
    with pytest.raises(BadRecording, match="no message was received"):
        prepare_pieces(list[Recording](), ur10())  # type: ignore[arg-type]
