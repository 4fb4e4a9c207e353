"""Which bags are meant by what is given, and what they are called."""

from __future__ import annotations

from pathlib import Path

import pytest

from modcal_core.errors import BadRecording, BadTable
from modcal_nodes.fleet.recordings import find_bags, names_of


@pytest.fixture
def recordings(tmp_path: Path) -> Path:
    top = tmp_path / "recordings"
    for file in ("r1/monday/metadata.yaml", "r1/monday/monday_0.mcap", "r1/cut/cut_0.mcap", "r1/cut/cut_1.mcap",
                 "r2/a.mcap", "r2/b.mcap", ".old/x/x_0.mcap", "out/r1/monday/report.json", "r3/a.mcap"):  # fmt: skip
        (top / file).parent.mkdir(parents=True, exist_ok=True)
        (top / file).touch()
    return top


def test_folders_are_searched(recordings: Path) -> None:
    found = find_bags([str(recordings)], recordings / "out")
    assert [str(p.relative_to(recordings)) for p in found] == [
        "r1/cut", "r1/monday", "r2/a.mcap", "r2/b.mcap", "r3/a.mcap",
    ]  # fmt: skip
    assert find_bags([str(recordings / "r1"), str(recordings / "r1/monday")], recordings / "out") == found[:2]


def test_patterns_are_matched(recordings: Path) -> None:
    found = find_bags([f"{recordings}/r*/a.mcap"], recordings / "out")
    assert [p.parent.name for p in found] == ["r2", "r3"]


@pytest.mark.parametrize("name", ["nowhere", "no*where", "r1/monday/metadata.yaml/*"])
def test_what_is_not_there_is_refused(recordings: Path, name: str) -> None:
    with pytest.raises(BadRecording, match="does not exist"):
        find_bags([str(recordings / name)], recordings / "out")


def test_a_folder_without_bags_is_refused(recordings: Path) -> None:
    with pytest.raises(BadRecording, match="holds no bag"):
        find_bags([str(recordings / "out")], recordings / "elsewhere")


def test_names_are_told_apart_and_stay(tmp_path: Path) -> None:
    one, two, other = (tmp_path / p for p in ("x/r/a.mcap", "y/r/a.mcap", "y/r/b.mcap"))
    for file in (one, two, other):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.touch()
    out = tmp_path / "out"
    assert names_of([one], out) == {"r/a": one}
    names = names_of([one, two, other], out)
    assert len(names) == 3
    assert names["r/b"] == other
    assert names_of([two, one], out).items() <= names.items()


def test_a_bag_is_never_written_over(tmp_path: Path) -> None:
    """Not even one in whose folder somebody has put a report."""
    bag = tmp_path / "r" / "a"
    bag.mkdir(parents=True)
    (bag / "report.json").touch()
    assert names_of([bag], tmp_path / "out") == {"r/a": bag}
    with pytest.raises(BadTable, match="holds something other than results"):
        names_of([bag], tmp_path)
