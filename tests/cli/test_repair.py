"""``modcal repair`` as a person meets it."""

from __future__ import annotations

from pathlib import Path

import pytest
from cli.conftest import Refused
from cli.recordings import stations
from mcap.reader import make_reader

from modcal_msgs_py.recording_write import write_recording
from modcal_nodes.cli.main import run


def said(capfd: pytest.CaptureFixture[str]) -> tuple[str, str]:
    out, err = capfd.readouterr()
    return " ".join(out.split()), err


def test_a_cut_bag_is_repaired_beside_itself(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    write_recording(stations(40), tmp_path / "bag")
    file = tmp_path / "bag" / "bag_0.mcap"
    (tmp_path / "bag" / "metadata.yaml").unlink()
    data = file.read_bytes()
    file.write_bytes(data[: int(0.6 * len(data))])
    assert run(["repair", str(tmp_path / "bag")]) == 0
    with (tmp_path / "bag_repaired" / "bag_repaired_0.mcap").open("rb") as stream:
        reader = make_reader(stream)
        saved: dict[str, int] = {}
        for _, channel, _ in reader.iter_messages():
            saved[channel.topic] = saved.get(channel.topic, 0) + 1
    assert saved["/joint_states"] > 10
    text, err = said(capfd)
    assert err == ""
    for topic, count in saved.items():
        assert f"{topic} {count}" in text
    assert "metadata.yaml is missing" in text
    assert "bytes at the end are an unfinished record" in text
    assert f"{sum(saved.values())} messages saved" in text
    # the new bag is one that calibrate takes, without a word about a cut
    assert run(["info", str(tmp_path / "bag_repaired")]) == 0
    assert "read up to" not in said(capfd)[0]


def test_a_whole_bag_is_left_alone(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    write_recording(stations(10), tmp_path / "bag")
    for bag in (tmp_path / "bag", tmp_path / "bag" / "bag_0.mcap"):
        assert run(["repair", str(bag)]) == 0
        assert "is whole (21 messages): nothing to repair" in said(capfd)[0]
    assert [p.name for p in tmp_path.iterdir()] == ["bag"]


def test_what_is_no_bag_is_refused_in_one_line(tmp_path: Path, refused: Refused) -> None:
    (tmp_path / "notes.mcap").write_text("these are my notes")
    refused(["repair", str(tmp_path / "notes.mcap"), "--out", str(tmp_path / "a" / "b")], "is not an MCAP file")
