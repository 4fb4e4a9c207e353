"""Files and options that say what cannot be: one line with the place; what a cell file states is taken."""

from __future__ import annotations

import copy
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from cli.conftest import Refused

from modcal_core.calibration.fit import Move
from modcal_core.calibration.stated import Stated
from modcal_core.calibration.store import from_data
from modcal_core.errors import BadTable
from modcal_core.files import parse_yaml
from modcal_core.schema import require
from modcal_msgs_py import Topics
from modcal_msgs_py.tables.convert import SCHEMA
from modcal_nodes.io.inputs import read_cell, read_topics, stated_from

ROWS = "t;a;b;x;y;z;r;p;w\n" + "".join(f"{t};0,{t};0,2;1,0;2,0;3,{t};0,1;0,2;0,3\n" for t in range(1, 9))
MAPPING: dict[str, Any] = {
    "tables": [
        {
            "files": "rows.csv",
            "delimiter": ";",
            "decimal": ",",
            "time": {"seconds": "t"},
            "joints": {"unit": "rad", "columns": {"j1": "a", "j2": "b"}},
            "pose": {
                "frame": "tracker",
                "unit": "m",
                "position": ["x", "y", "z"],
                "euler": {"columns": ["r", "p", "w"], "sequence": "XYZ", "unit": "rad"},
            },
        }
    ]
}


def changed(path: str, value: Any) -> Any:
    """The mapping with one value changed: keys and numbers of entries with dots between them."""
    data = copy.deepcopy(MAPPING)
    *way, last = path.split(".")
    place: Any = data
    for key in way:
        place = place[int(key)] if isinstance(place, list) else place.setdefault(key, {})
    if isinstance(place, list):
        place[int(last)] = value
    else:
        place[last] = value
    return data


WRONG: list[tuple[str, Any, str]] = [
    ("tables", 3, "m.yaml: tables: 3 is not a list"),
    ("tables", [], "at least 1 are allowed"),
    ("tables.0.delimiter", ";;", "tables, entry 1: delimiter: ';;' has 2 letters, 1 are allowed"),
    ("tables.0.delimiter", ",", "is the delimiter too"),
    ("tables.0.decimal", ",,", "decimal: ',,' is not one of ., ,"),
    ("tables.0.encoding", "klingon", "is not text in the encoding klingon"),
    ("tables.0.encoding", "base64", "is not text in the encoding base64"),
    ("tables.0.files", "/etc/*", "is not a file pattern"),
    ("tables.0.joints", {"columns": [1, 2], "unit": "rad"}, "joints: columns: [1, 2] is not a mapping"),
    ("tables.0.joints.columns", {}, "is empty"),
    ("tables.0.joints.columns.j1", None, "is not a text or a whole number"),
    ("tables.0.joints.torque", {"j1": "a"}, "joints: unknown key torque; known are columns, commanded, coupled"),
    ("tables.0.joints.effort", {"j1": "a"}, "joints: effort: 'columns' is not stated"),
    ("tables.0.joints.effort", {"columns": {"j9": "a"}}, "joints: effort: j9 has no position column"),
    ("tables.0.time", {"format": "%Q", "column": "t"}, "is not %Q"),
    ("tables.0.time", {"format": "%Y%Y", "column": "t"}, "is not %Y%Y"),
    ("tables.0.time", {"order": {"period_s": 0}}, "is not above 0"),
    ("tables.0.time", {"order": {"period_s": float("nan")}}, "is not a finite number"),
    ("tables.0.time", {}, "0 of these ways are stated"),
    ("tables.0.pose.frame", "{", "only {stem} and {folder} are known"),
    ("tables.0.pose.frame", "{stem.__class__}", "only {stem} and {folder} are known"),
    ("tables.0.pose.frame", "\ud800", "is not YAML"),
    ("tables.0.pose.position", ["x", "y"], "has 2 entries, 3 are allowed"),
    ("tables.0.pose.inverse", "false", "is not true or false"),
    ("tables.0.pose.euler.sequence", "abc", "sequence 'abc'"),
    ("tables.0.temperature", {"a": {"b": 1}}, "is not a text or a whole number"),
    ("urdf", 5, "is not a text or nothing"),
    ("colour", "red", "unknown key colour"),
]  # fmt: skip


@pytest.mark.parametrize(("path", "value", "said"), WRONG)
def test_mappings_that_say_what_cannot_be(path: str, value: Any, said: str, tmp_path: Path, refused: Refused) -> None:
    (tmp_path / "rows.csv").write_text(ROWS)
    (tmp_path / "m.yaml").write_text(yaml.safe_dump(changed(path, value)))
    refused(["import", str(tmp_path / "m.yaml"), "--out", str(tmp_path / "bag")], re.escape(said))
    assert not (tmp_path / "bag").exists()


@pytest.mark.parametrize("cell", ["nan", "inf", "1e300", "-5", "", "9e9"])
def test_times_that_cannot_be(cell: str, tmp_path: Path, refused: Refused) -> None:
    (tmp_path / "rows.csv").write_text(ROWS.replace("\n3;", f"\n{cell};"))
    (tmp_path / "m.yaml").write_text(yaml.safe_dump(MAPPING))
    refused(["import", str(tmp_path / "m.yaml"), "--out", str(tmp_path / "bag")], re.escape("line 4, column t"))


def mappings_of(data: Any, way: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The ways to every mapping, in lists their first entry."""
    if isinstance(data, dict):
        return [way, *(here for key, value in data.items() for here in mappings_of(value, (*way, key)))]
    return mappings_of(data[0], (*way, 0)) if isinstance(data, list) and data else []


def keys_of(data: Any, way: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The ways to every key of mappings in mappings, and in the first entry of lists."""
    if isinstance(data, dict):
        return [here for key, value in data.items() for here in ((*way, key), *keys_of(value, (*way, key)))]
    return keys_of(data[0], (*way, 0)) if isinstance(data, list) and data else []


@pytest.mark.slow
def test_a_key_of_a_calibration_that_nobody_reads(folder: Path) -> None:
    """Refused with its path and what is known there; names that are free, and settings of shapes, may be any."""
    calibration = parse_yaml((folder / "a" / "calibration.yaml").read_text(), "calibration")
    effect = {**dict.fromkeys(("family", "place", "direction"), "x"), "driver": "time", "shape": {"kind": "linear"},
              "values": [0.0], "std": [0.0]}  # fmt: skip
    data = {**copy.deepcopy(calibration), "rivals": [[effect]], "ranges": {"temperature:a": [1.0, 2.0]}}
    data["noise"]["others"] = {"range": 1e-4}
    free = {"ranges", "others"}
    ways = mappings_of(data)
    assert len(ways) >= 15
    for way in ways:
        if way and way[-1] in free:
            continue
        spoilt = copy.deepcopy(data)
        place: Any = spoilt
        for key in way:
            place = place[key]
        place["repeatabilty"] = 1.0
        with pytest.raises(BadTable, match="unknown key repeatabilty; known are ") as found:
            from_data(spoilt, "c.yaml")
        path = "c.yaml" + "".join(f", entry {key + 1}" if isinstance(key, int) else f": {key}" for key in way)
        assert found.value.offender == path
        assert all(key in found.value.limit for key in place if key != "repeatabilty")
    from_data(calibration, "c.yaml")


@pytest.mark.slow
def test_a_calibration_without_a_key(folder: Path) -> None:
    """Without any one of its keys it is read, where the key is optional, or refused by name; nothing else."""
    calibration = parse_yaml((folder / "a" / "calibration.yaml").read_text(), "calibration")

    def spoilt(way: tuple[Any, ...], act: Callable[[Any, Any], None]) -> dict[str, Any]:
        data = copy.deepcopy(calibration)
        place: Any = data
        for key in way[:-1]:
            place = place[key]
        act(place, way[-1])
        return data

    def gone(place: Any, key: Any) -> None:
        del place[key]

    def set_to(value: Any) -> Callable[[Any, Any], None]:
        return lambda place, key: place.__setitem__(key, value)

    refusals: list[BadTable] = []
    for way in keys_of(calibration):
        for act in (gone, *(set_to(value) for value in (None, 3, "x", [], {}, float("nan"), [[1]], -1e400))):
            try:
                from_data(spoilt(way, act), "c.yaml")
            except BadTable as error:
                refusals.append(error)
    assert len(refusals) > 200
    assert all("c.yaml" in error.offender or "calibration" in error.offender for error in refusals)


@pytest.mark.parametrize("text", ["[" * 5000, "- " * 5000, "{a: " * 5000, "a: 2001-99-99", "a: 0x" + "f" * 9000, "a: " + "9" * 9000,
                                  "? [1]\n: 2", "a: !!python/object:os.system x", "\x00", "a: *b", "&a [*a]", "a: 1\x1b", "a: <<"])  # fmt: skip
def test_yaml_that_leads_a_loader_astray(text: str, tmp_path: Path, refused: Refused) -> None:
    """Refused in one line by every verb that reads YAML; deep ones used to end the process."""
    (tmp_path / "f.yaml").write_text(text)
    file = str(tmp_path / "f.yaml")
    for arguments in (
        ["import", file],
        ["evaluate", file, file],
        ["assemble", file],
        ["synthesize", file],
        ["export", file, "--to", "urdf"],
    ):
        refused(arguments, re.escape("f.yaml"))


def test_a_schema_of_unknown_words_is_a_mistake() -> None:
    """A word that is passed over would check nothing."""
    with pytest.raises(AssertionError):
        require({}, {"pattern": "x"}, "", "")
    require(MAPPING, SCHEMA, "m.yaml", "")


def test_numbers_with_an_exponent_alone_are_numbers() -> None:
    read = parse_yaml("[2e-05, -1E3, 1.5e2, .5e1, 2e, e5, 1e5x, 12]", "t")
    assert read == [2e-05, -1e3, 150.0, 5.0, "2e", "e5", "1e5x", 12]


def written(folder: Path, text: str) -> Path:
    """A cell file with this text."""
    (folder / "cell.yaml").write_text(text + "\n")
    return folder / "cell.yaml"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        *(
            (f"distances: [{{between: [a, b], distance_m: {m}}}]", "is not above 0|at most 50")
            for m in (-0.3, 0.0, 51.0)
        ),
        ("distances: [{between: [a, b], distance_m: .nan}]", "distance_m: nan is not a finite number"),
        ("payloads: [{centre_m: [0, 0, 0.05]}]", "mass_kg"),
        ("payloads: [{mass_kg: -1}]", "mass_kg: -1 is out of range, 0.0 to 5000.0"),
        ("payloads: [{mass_kg: 1, centre_m: [0, 0, 50]}]", "centre_m, entry 3: 50 is out of range"),
        ("payloads: [{mass_kg: 1, centre_m: [0, 0]}]", "payloads"),
        ("payloads: [{mass_kg: 1, center_m: [0, 0, 0]}]", "center_m"),
        ("moved: [{stamp: 1.0, what: table}]", "base, tool, both"),
        ("own_in_recordings: hand", "base, tool, both"),
        ("repeatability_mm: some", "repeatability_mm"),
        ("instrument_mm: [1]", "instrument_mm"),
        ("repeatability: 0.02", "repeatability"),
        ("topics: {tracker/pose: 3}", "topics"),
        ("topics: {tool: /a}", "tool"),
        ("tf: a", "tf"),
        ("ignore: [3]", "ignore"),
    ],
)
def test_what_cannot_be_is_refused_with_the_file(text: str, said: str, tmp_path: Path) -> None:
    file = written(tmp_path, text)
    with pytest.raises(BadTable, match=said) as refused:
        read_topics(file, Topics()) if text.startswith(("topics", "tf", "ignore")) else read_cell(file)
    assert text.startswith(("topics", "tf")) or str(file) in str(refused.value)


def test_what_is_stated_is_taken_as_it_is_written(tmp_path: Path) -> None:
    cell = read_cell(
        written(
            tmp_path,
            "distances: [{between: [a, b], distance_m: 0.3, std_m: 1.0e-4}]\n"
            "payloads: [{mass_kg: 2.5, centre_m: [0.01, 0, 0.05]}, {mass_kg: 0}]\n"
            "moved: [{stamp: 20.5, what: base}, {stamp: 10.5, what: tool}]\nown_in_recordings: both",
        )
    )
    (known,) = cell.distances
    assert (known.distance, known.std) == (0.3, 1e-4)
    assert [(one.mass, one.place) for one in cell.payloads] == [(2.5, (0.01, 0.0, 0.05)), (0.0, (0.0, 0.0, 0.0))]
    assert cell.moved == (Move(10.5, "tool"), Move(20.5, "base"))
    assert cell.own_in_recordings == "both"
    assert [m.at for m in cell.with_move(Move(15.0, "both")).moved] == [10.5, 15.0, 20.5]


def test_the_command_line_goes_before_the_file(tmp_path: Path) -> None:
    file = written(tmp_path, "fixed: [tool]\nrepeatability_iso: 0.05\ninstrument_mm: 0.02\ninstrument_deg: 0.01")
    cell = read_cell(file)
    assert cell.fixed == ("tool",)
    assert cell.stated == Stated(repeatability_iso_mm=0.05, instrument_mm=0.02, instrument_deg=0.01)
    both = read_cell(file, stated=stated_from({"repeatability_mm": 0.01, "instrument_mm": 0.03})).stated
    assert both == Stated(repeatability_mm=0.01, instrument_mm=0.03, instrument_deg=0.01)
    alone = read_cell(None, stated=stated_from({"repeatability_iso": 0.1})).stated
    assert alone.rms_mm == pytest.approx(0.0479, abs=1e-4)
