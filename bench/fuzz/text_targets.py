"""Texts that are fuzzed: URDF files, tables with their mappings, cell files, calibrations, reports, YAML as such."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from data_cases import case as data_case
from data_cases import places, text_case
from target import URDF, Target, yaml_text

from modcal_core.calibration.model import Model
from modcal_core.calibration.store import Calibration, from_data, to_data
from modcal_core.correction.correction import Correction
from modcal_core.effects.effect import JOINTS, Effect
from modcal_core.effects.shapes import Shape
from modcal_core.files import parse_yaml, to_yaml
from modcal_core.robots.chain import Chain
from modcal_core.robots.loaded_arm import LoadedArm
from modcal_core.robots.urdf import read_chain
from modcal_msgs_py.choosing import Topics
from modcal_msgs_py.recording_write import write_recording
from modcal_msgs_py.tables import import_tables
from modcal_nodes.calibrating.standing import standing_of_json
from modcal_nodes.io.inputs import read_cell, read_topics

URDF_WORDS = (
    "nan", "inf", "1e400", "-1", "0 0 0", "0 0", "", "<link name='a'/>", "<joint", "</robot>", "<robot>", "&#0;", "&amp;", "<!--",
    "<![CDATA[", "continuous", "prismatic", "planar", "floating", "mimic", "<mimic joint='elbow_joint'/>", "world", "base_link",
    "<!DOCTYPE a [<!ENTITY b 'c'>]>", "&b;", "<inertial>", "\ud7ff", "\x1b", "name='elbow_joint'", "tool0", "1e308",
)  # fmt: skip


def urdf_target() -> Target:
    """Robot descriptions, as chains and as loaded arms."""
    text = URDF.read_text()

    def run(case: str) -> None:
        chain = read_chain(case, None, None)
        chain.reach()
        LoadedArm.read(case, chain.base, chain.tip)

    return Target("urdf", lambda rng: text_case(text, URDF_WORDS, rng), run)


ROWS = "t;a;b;x;y;z;r;p;w;d\n" + "".join(f"{t};0,{t};0,2;1,0;2,0;3,{t};0,1;0,2;0,3;2020010{t}\n" for t in range(1, 9))
MAPPING = {
    "tables": [
        {
            "files": "rows.csv", "delimiter": ";", "decimal": ",", "encoding": "utf-8", "header": True,
            "time": {"seconds": "t"}, "joints": {"unit": "rad", "columns": {"j1": "a", "j2": "b"}},
            "pose": {"frame": "tracker", "unit": "m", "position": ["x", "y", "z"], "inverse": False,
                     "euler": {"columns": ["r", "p", "w"], "sequence": "XYZ", "unit": "rad"}},
            "temperature": {"base": "a"},
        },
        {
            "files": "rows.csv", "delimiter": ";", "decimal": ",", "time": {"order": {"period_s": 10.0}},
            "joints": {"unit": "deg", "columns": {"j1": 1, "j2": "b"}},
            "point": {"frame": "{stem}", "unit": "mm", "position": ["x", 4, "z"]},
        },
        {
            "files": "row*.csv", "delimiter": ";", "time": {"column": "d", "format": "%Y%m%d"}, "decimal": ",",
            "joints": {"unit": "deg", "columns": {"j1": 1, "j2": "b"}},
            "pose": {"frame": "{folder}", "unit": "mm", "position": ["x", 4, "z"], "quaternion": {"columns": [3, 4, 5, 6]}},
        },
    ]
}  # fmt: skip
CSV_WORDS = (";", ",", "nan", "1e400", "-", "\n", '"', "\x00", "1_0", "٣", "0,0", ";;;;", "t", "\r")


def mapping_target(folder: Path) -> Target:
    """Mappings of import with a table as it should be, and tables that are not with the mapping as it should be."""
    ways = places(MAPPING)
    rows = folder / "rows.csv"

    def make(rng: np.random.Generator) -> tuple[Any, str]:
        if rng.integers(4):
            return data_case(MAPPING, ways, rng), ROWS
        return MAPPING, text_case(ROWS, CSV_WORDS, rng)

    def run(case: tuple[Any, str]) -> None:
        mapping, text = case
        rows.write_text(text, encoding="utf-8", errors="surrogateescape")
        made = import_tables(mapping, folder, "mapping")
        shutil.rmtree(folder / "imported", ignore_errors=True)
        write_recording(made, folder / "imported")

    return Target("mapping", make, run)


CELL = {
    "distances": [{"between": ["a", "b"], "distance_m": 0.05, "std_m": 1e-5}, {"stamps": [1.0, 2.0], "distance_m": 0.05}],
    "fixed": ["tool"], "known": [{"frame": "a", "in": "b", "plane": {"normal": [0, 0, 1], "offset_m": 0.1}},
                                {"frame": "a", "in": "b", "position_m": [0, 0, 1], "quaternion": [0, 0, 0, 1]}],
    "own_target": ["a"], "sockets": ["a"], "moved": [{"stamp": 1.5, "what": "tool"}], "own_in_recordings": "tool",
    "repeatability_mm": 0.02, "instrument_mm": 0.01, "instrument_deg": 0.01,
    "topics": {"tracker/pose": "/a", "joint_states": ["/b"]}, "ignore": ["/c"], "tf": "a:b",
}  # fmt: skip


def cell_target(folder: Path) -> Target:
    """Cell files, through YAML as a person writes them."""
    ways, file = places(CELL), folder / "cell.yaml"

    def run(case: Any) -> None:
        file.write_text(yaml_text(case), encoding="utf-8")
        read_cell(file)
        read_topics(file, Topics())

    return Target("cell", lambda rng: data_case(CELL, ways, rng), run)


def calibration() -> dict[str, Any]:
    """A calibration with effects and parameters, as data."""
    chain = read_chain(URDF.read_text(), None, "tool0")
    effects = (
        Effect("latency", "tracker", JOINTS, "velocity", Shape("linear")).started(np.zeros(1)),
        Effect("compliance", "elbow_joint", "axis", "load:elbow_joint", Shape("linear")).started(np.zeros(1)),
    )
    model = Model(chain, ("tracker",), np.eye(4)[None], np.eye(4))
    whole = Calibration(
        model, replace(model, effects=effects), model, np.array([[-1.0] * chain.n, [1.0] * chain.n]),
        (("elbow_joint/zero", 0.1, 0.01, "rad"),), postures=np.zeros((3, chain.n)), watched=(1.0, 2.0),
        ranges={"temperature:a": (1.0, 2.0)}, scatter=(1e-4, 1e-4),
    )  # fmt: skip
    data: dict[str, Any] = parse_yaml(to_yaml(to_data(whole)), "calibration")
    return data


def calibration_target() -> Target:
    """Calibrations; one that is read must predict, correct, and be written again."""
    base = calibration()
    ways = places(base)

    def run(case: Any) -> None:
        read = from_data(case, "calibration.yaml")
        n = len(read.nominal.chain.names)
        for model in (read.nominal, read.calibrated, read.geometric):
            model.predict(np.zeros((2, n)))
        if isinstance(read.calibrated.chain, Chain):
            Correction(read)
        from_data(parse_yaml(to_yaml(to_data(read)), "again"), "again")

    return Target("calibration", lambda rng: data_case(base, ways, rng), run)


def report_target() -> Target:
    """report.json as the calibrator reads it back, and any JSON there."""
    base = {
        "modcal_report": 1,
        "status": "open",
        "open_because": ["a"],
        "remedy": "b",
        "verdict": "c",
        "error_mm": {"final": {}},
    }
    ways = places(base)

    def make(rng: np.random.Generator) -> str:
        if rng.integers(3):
            return json.dumps(data_case(base, ways, rng), default=str)
        return text_case(json.dumps(base), ('"', "[" * 3000, "{", "nan", "\\ud800", "1e999", "9" * 5000, "null"), rng)

    return Target("report", make, lambda case: standing_of_json(case) and None)


YAML_WORDS = ("- ", "? ", "[", "{", "&a ", "*a", "<<: *a", "!!python/object:os.system", "!!binary x", "2001-99-99", "0x" + "f" * 5000,
              "9" * 5000, ": ", "\n", "\t", "---\n", "...", "%YAML 9", "|", ">", "!!set", "!!timestamp x", "1:2:3", ".nan", "~")  # fmt: skip


def yaml_target() -> Target:
    """Texts that may be YAML."""
    text = yaml_text(CELL) + "a: &a {b: 1}\nc: {<<: *a, d: 2001-01-01}\n"
    return Target(
        "yaml", lambda rng: text_case(text, YAML_WORDS, rng), lambda case: parse_yaml(case, "f.yaml") and None
    )
