"""Input that cannot be used: exit code 2, one line with offender, limit and remedy, and nothing written.

The table of docs/bad_input.md lists the most usual of these cases.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cli.conftest import Refused
from cli.recordings import URDF, part, stations, streams, with_joints, with_reading

from modcal_core.measurements.recording import Recording
from modcal_msgs_py.mcap_read import read_recording
from modcal_msgs_py.recording_write import write_recording
from modcal_nodes.cli.main import run

ROOT = Path(__file__).resolve().parents[2]


def swapped(r: Recording) -> Recording:
    names = list(r.joints[0].names)
    names[1], names[2] = names[2], names[1]
    return with_joints(r, names=tuple(names))


def between(r: Recording) -> Recording:
    """Zeros of a joint_state_publisher between the driver's positions."""
    track = r.joints[0]
    stamps = np.concatenate([track.stamps, track.stamps + 0.003])
    order = np.argsort(stamps)
    unknown = np.full((len(stamps), 6), np.nan)
    q = np.concatenate([track.position, np.zeros_like(track.position)])[order]
    return with_joints(r, stamps=stamps[order], position=q, velocity=unknown, effort=unknown, received=stamps[order])


def missing(r: Recording) -> Recording:
    track = r.joints[0]
    unknown = np.full((len(track.stamps), 5), np.nan)
    return with_joints(r, names=track.names[:5], position=track.position[:, :5], velocity=unknown, effort=unknown)


def with_values(change: Callable[[np.ndarray], np.ndarray]) -> Recording:
    """The stations with their poses changed."""
    made = stations()
    return with_reading(made, values=change(made.readings[0].values.copy()))


CASES: dict[str, tuple[Callable[[], Recording], list[str], str]] = {
    "every joint position is NaN": (lambda: with_joints(stations(), position=stations().joints[0].position * [1, 1, np.nan, 1, 1, 1]), [], "joint elbow_joint: position is not finite in any of 80 messages"),
    "every reading is NaN": (lambda: with_values(lambda x: x * np.nan), [], r"/tracker/pose \(tracker\): not finite in all of 80"),
    "positions in millimetres": (lambda: with_values(lambda x: x * np.r_[[1e3] * 3, [1.0] * 4]), [], "looks like millimetres.*record metres"),
    "joints in degrees": (
        lambda: with_joints(stations(), position=np.degrees(stations().joints[0].position)), [], "looks like degrees.*radians"
    ),
    "two joint names swapped": (lambda: swapped(stations()), [], "shoulder_lift_joint and elbow_joint look swapped"),
    "a joint is missing": (lambda: missing(stations()), ["--tip", "tool0"], "joint wrist_3_joint: not among the joint states"),
    "tracker silent": (lambda: replace(stations(), readings=()), [], r"tracker: no message on tracker/pose.*recorded are .*/joint_states \(JointState\)"),
    "no joint states": (lambda: replace(stations(), joints=()), ["--tip", "tool0"], "joint states: no message"),
    "tracker clock 2 s off (streams)": (lambda: streams(late=2.0), [], r"clock of /tracker/pose.*2\.00 s off.*limit"),
    "tracker clock 2 s off (paired stations)": (
        lambda: with_reading(stations(40), stamps=stations(40).readings[0].stamps + 2.0), [], "readings look .* by 1 station:"
    ),
    "tracker clock 0.7 s off (paired stations)": (
        lambda: with_reading(stations(), stamps=stations().readings[0].stamps + 0.7), [], r"stamped \+0.700 s off"
    ),
    "clocks a day apart": (lambda: streams(8, late=86400.0), [], "do not overlap in time"),
    "quaternion not of unit length": (lambda: with_values(lambda x: x * np.r_[[1.0] * 3, [1.5] * 4]), [], "a quaternion has length 1.500"),
    "link of --tip not in the URDF": (stations, ["--tip", "tool1"], "link 'tool1': is not in the robot .*tool0"),
    "--tip names the link before the last joint": (
        lambda: stations(40), ["--tip", "wrist_2_link"], "wrist_3_joint moved as well and is not between base and tip"
    ),
    "two publishers of joint states": (
        lambda: between(streams(8)), [], r"/joint_states: the position of \w+: jumps to and fro.*two nodes publish"
    ),
    "no robot description": (lambda: replace(stations(), robot_description=None), [], "holds no robot_description.*--urdf"),
    "robot description is no URDF": (lambda: replace(stations(), robot_description="<sdf/>"), [], "is <sdf>, not <robot>"),
    "another robot's URDF": (
        lambda: replace(stations(40), robot_description=URDF.read_text().replace('"-0.612 0 0"', '"-0.4 0 0"')), [],
        "the origin of joint elbow_joint in the URDF looks wrong",
    ),
    "5 stations for 42 parameters": (lambda: part(stations(), slice(5)), [], "5 stations for 30 parameters: the 70% of them that fit give 24"),
    "--fix names nothing": (stations, ["--fix", "elbow"], "fixed parameter 'elbow': matches no parameter"),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_bad_recordings(case: str, tmp_path: Path, refused: Refused) -> None:
    make, arguments, said = CASES[case]
    write_recording(make(), tmp_path / "bag")
    refused(["calibrate", str(tmp_path / "bag"), "--geometry-only", *arguments, "--out", str(tmp_path / "out")], said)
    assert {p.name for p in tmp_path.iterdir()} == {"bag"}


def empty(folder: Path) -> Path:
    from modcal_msgs_py.mcap_write import BagWriter

    with BagWriter(folder / "empty") as bag:
        bag.add_topic("/joint_states", "sensor_msgs/msg/JointState")
    return folder / "empty"


def text_file(folder: Path) -> Path:
    (folder / "notes.mcap").write_text("these are my notes")
    return folder / "notes.mcap"


def table(folder: Path) -> Path:
    (folder / "tracker.CSV").write_text("J1,J2,X,Y,Z\n0,0,1,1,1\n")
    return folder / "tracker.CSV"


def zero_bytes(folder: Path) -> Path:
    (folder / "zero.mcap").touch()
    return folder / "zero.mcap"


def bare_folder(folder: Path) -> Path:
    (folder / "nothing").mkdir()
    return folder / "nothing"


def folder_of_bags(folder: Path) -> Path:
    (folder / "bags" / "morning").mkdir(parents=True)
    (folder / "bags" / "morning" / "morning_0.mcap").write_bytes(b"")
    return folder / "bags"


def sqlite_bag(folder: Path) -> Path:
    (folder / "old").mkdir()
    (folder / "old" / "old_0.db3").write_bytes(b"SQLite format 3\x00")
    return folder / "old"


FILES: dict[str, tuple[Callable[[Path], Path], str]] = {
    "bag without messages": (empty, "holds no message"),
    "file that is not MCAP": (text_file, "is not an MCAP file"),
    "table in place of a bag": (table, r"tracker.CSV --urdf ROBOT"),
    "file of no bytes": (zero_bytes, "is empty"),
    "folder without a bag": (bare_folder, "holds no .mcap or .db3 file"),
    "folder of bags": (folder_of_bags, "holds no .mcap or .db3 file: give one of the bags in it: morning"),
    "SQLite bag": (sqlite_bag, "cannot be read as a SQLite bag"),
    "path that does not exist": (lambda folder: folder / "no_such_bag", "does not exist"),
}


@pytest.mark.parametrize("case", FILES)
def test_bad_files(case: str, tmp_path: Path, refused: Refused) -> None:
    make, said = FILES[case]
    path = str(make(tmp_path))
    for verb in ("calibrate", "info"):
        refused([verb, path], said)


@pytest.mark.slow
def test_cut_bag_is_read_up_to_the_cut(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    write_recording(streams(60), tmp_path / "bag")
    file = tmp_path / "bag" / "bag_0.mcap"
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    assert run(["calibrate", str(tmp_path / "bag"), "--geometry-only", "--out", str(tmp_path / "out")]) == 0
    assert "bag_0.mcap was read up to its message" in " ".join(capfd.readouterr().out.split())
    assert "read up to its message" in (tmp_path / "out" / "report.json").read_text()
    recording = read_recording(tmp_path / "bag")
    assert 0.4 < recording.duration / read_whole(whole, tmp_path).duration < 0.6


def read_whole(data: bytes, folder: Path) -> Recording:
    (folder / "whole.mcap").write_bytes(data)
    return read_recording(folder / "whole.mcap")


@pytest.mark.slow
def test_a_small_clock_offset_is_corrected_and_said(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    write_recording(streams(40, late=0.12), tmp_path / "bag")
    assert run(["calibrate", str(tmp_path / "bag"), "--geometry-only", "--out", str(tmp_path / "out")]) == 0
    assert "off the joint states' clock" in " ".join(capfd.readouterr().out.split())


@pytest.mark.parametrize(
    ("option", "given", "said"),
    [
        ("--tolerance-mm", "0,2", "'0,2' is not a number: write 0.2."),
        ("--tolerance-mm", "0.2mm", "'0.2mm' is not a number: write 0.2."),
        ("--tolerance-mm", "small", "'small' is not a number."),
        ("--clock-limit", "nan", "'nan' is not a finite number."),
        ("--block", "1.5", "'1.5' is not a valid whole number."),
    ],
)
def test_what_is_no_number_is_said_in_plain_words(
    option: str, given: str, said: str, tmp_path: Path, refused: Refused
) -> None:
    refused(["calibrate", str(tmp_path), option, given], re.escape(said))


def test_blocks_as_long_as_the_recording_leave_nothing_to_hold_out(tmp_path: Path, refused: Refused) -> None:
    write_recording(stations(), tmp_path / "bag")
    told = ["calibrate", str(tmp_path / "bag"), "--geometry-only", "--out", str(tmp_path / "out"), "--block"]
    refused([*told, "5000"], "--block 5000: 80 stations .* give at most --block 8$")
    assert run([*told, "8"]) == 0


def test_a_joint_that_was_counted_on_by_a_turn_is_not_called_degrees_alone(tmp_path: Path, refused: Refused) -> None:
    q = stations().joints[0].position.copy()
    q[:, 5] += 4.0 * np.pi
    write_recording(with_joints(stations(), position=q), tmp_path / "bag")
    refused(["calibrate", str(tmp_path / "bag")], "degrees, or whole turns .* limits in the URDF")


def test_the_page_lists_cases_of_ours() -> None:
    table = (ROOT / "docs" / "bad_input.md").read_text().partition("Some input is used all the same")[0]
    listed = re.findall(r"^\| ([^|]+) \| `modcal: ", table, re.MULTILINE)
    assert len(listed) > 10
    assert set(listed) <= {*CASES, *FILES}


@pytest.mark.parametrize(
    "verb", [["target", "--charuco", "7x5", "--square", "30mm"], ["repair", "."], ["history", "."]]
)
def test_an_empty_name_is_not_the_current_folder(
    verb: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """``--out "$FOLDER"`` with nothing in FOLDER wrote the results among whatever was there."""
    monkeypatch.chdir(tmp_path)
    assert run([*verb, "--out", ""]) == 2
    assert "is empty" in capfd.readouterr().err
    assert not list(tmp_path.iterdir())
