"""What is fuzzed: bags, texts, data of files, and messages with images. A new reader of a file is a new target here."""

from __future__ import annotations

import contextlib
import json
import shutil
import sqlite3
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import yaml
from cases import data_case, mcap_case, parts, places, spoilt, text_case

from modcal_core.calibration.model import Model
from modcal_core.calibration.store import Calibration, from_data, to_data
from modcal_core.camera.bundle import MarkerBundle
from modcal_core.camera.target_file import target_from_data
from modcal_core.correction import Correction
from modcal_core.effects.effect import JOINTS, Effect
from modcal_core.effects.shapes import Shape
from modcal_core.errors import ModcalError
from modcal_core.files import parse_yaml, to_yaml
from modcal_core.geometry import se3
from modcal_core.measurements.inspection import inspect
from modcal_core.measurements.recording import JointTrack, ReadingTrack, Recording, SignalTrack
from modcal_core.modules.coding import assembly_from_data
from modcal_core.modules.library import library_from_data, published, published_text
from modcal_core.modules.synthesis import task_from_data
from modcal_core.planning.site import site_from_data
from modcal_core.planning.station_files import stations_from_data
from modcal_core.robots.acceleration import LoadedArm
from modcal_core.robots.chain import Chain
from modcal_core.robots.tables import from_table
from modcal_core.robots.urdf import read_chain
from modcal_msgs_py.images import CORNER, lens_data, raw_image, read_corners
from modcal_msgs_py.layout import message_class
from modcal_msgs_py.mcap_read import read_recording
from modcal_msgs_py.mcap_repair import repair_bag
from modcal_msgs_py.mcap_walk import McapFile
from modcal_msgs_py.mcap_write import BagWriter
from modcal_msgs_py.recording_write import write_recording
from modcal_msgs_py.tables import import_tables
from modcal_msgs_py.topics import Topics
from modcal_nodes.calibrating.diagnostics import standing_of
from modcal_nodes.io.inputs import read_cell, read_topics
from modcal_nodes.vision import grey_of
from modcal_nodes.vision.corner_table import corners_of
from modcal_nodes.vision.images import csv_cells, joints_of, lens_from_data

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
URDF = (EXAMPLES / "robots" / "ur10.urdf").read_text()
BASES = yaml.safe_load(Path(__file__).with_name("bases.yaml").read_text(encoding="utf-8"))
ROWS = "t;a;b;x;y;z;r;p;w;d\n" + "".join(f"{t};0,{t};0,2;1,0;2,0;3,{t};0,1;0,2;0,3;2020010{t}\n" for t in range(1, 9))
JOINT_NAMES = [f"{name}_joint" for name in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")]
URDF_WORDS = (
    "nan", "inf", "1e400", "-1", "0 0 0", "0 0", "", "<link name='a'/>", "<joint", "</robot>", "<robot>", "&#0;", "&amp;", "<!--",
    "<![CDATA[", "continuous", "prismatic", "planar", "floating", "mimic", "<mimic joint='elbow_joint'/>", "world", "base_link",
    "<!DOCTYPE a [<!ENTITY b 'c'>]>", "&b;", "<inertial>", "\ud7ff", "\x1b", "name='elbow_joint'", "tool0", "1e308",
)  # fmt: skip
CSV_WORDS = (";", ",", "nan", "1e400", "-", "\n", '"', "\x00", "1_0", "٣", "0,0", ";;;;", "t", "\r")
JSON_WORDS = ('"', "[" * 3000, "{", "nan", "\\ud800", "1e999", "9" * 5000, "null")
YAML_WORDS = (
    "- ", "? ", "[", "{", "&a ", "*a", "<<: *a", "!!python/object:os.system", "!!binary x", "2001-99-99", "0x" + "f" * 5000,
    "9" * 5000, ": ", "\n", "\t", "---\n", "...", "%YAML 9", "|", ">", "!!set", "!!timestamp x", "1:2:3", ".nan", "~",
)  # fmt: skip
Rng = np.random.Generator
Make = Callable[[Rng], Any]
Run = Callable[[Any], Any]


@dataclass(frozen=True)
class Target:
    """make: a case from random numbers; run: what is done with it; but for a ModcalError all it raises is a fault.
    good: a case that is read.
    """

    name: str
    make: Make
    run: Run
    good: Any


def of_data(name: str, base: Any, run: Run) -> Target:
    ways = places(base)
    return Target(name, lambda rng: data_case(base, ways, rng), run, base)


def of_text(name: str, base: str, words: Sequence[str], run: Run) -> Target:
    return Target(name, lambda rng: text_case(base, words, rng), run, base)


def yaml_text(data: Any) -> str:
    """Data as a person writes them; nothing where they cannot be written."""
    try:
        return yaml.dump(data, Dumper=yaml.CDumper, allow_unicode=True)
    except UnicodeEncodeError:
        return "{}"


def recording() -> Recording:
    """A short recording of everything that a bag may hold."""
    t, q = 1.7e9 + np.arange(6.0), 0.1 * np.arange(36.0).reshape(6, 6)
    poses = se3.to_pose(se3.exp(q))
    wire = ReadingTrack("range", "wire", t, poses[:, :1], t, "/tracker/range")
    return Recording(
        (JointTrack(tuple(JOINT_NAMES), t, q, q, q, t),),
        (ReadingTrack("pose", "tracker", t, poses, t), wire),
        (SignalTrack("temperature:base_link", t, poses[:, :1], "/temperature"),),
        "<robot name='r'><link name='a'/><link name='b'/><joint name='elbow_joint' type='revolute'><parent link='a'/>"
        "<child link='b'/><limit lower='-1' upper='1' effort='1' velocity='1'/></joint></robot>",
        "made",
    )


def messages(folder: Path) -> list[tuple[str, str, bytes, int]]:
    write_recording(recording(), folder)
    file = McapFile(next(folder.glob("*.mcap")))
    return [(m.topic, m.type_name, bytes(m.cdr), m.received_ns) for m in file.messages()]


def bag_bytes(folder: Path) -> bytes:
    """A whole file with all of it, and with transforms, odometry and a type that only the bag defines."""
    header, stamp = message_class("std_msgs/msg/Header"), message_class("builtin_interfaces/msg/Time")
    kinds = ("Vector3", "Quaternion", "Transform", "TransformStamped")
    vector, quaternion, transform, stamped = (message_class(f"geometry_msgs/msg/{name}") for name in kinds)
    turn, nine = quaternion(0.0, 0.0, 0.0, 1.0), np.zeros(9)
    said = lambda frame, ns: header(stamp(1_700_000_000, ns), frame)  # noqa: E731
    one = stamped(said("tracker", 5), "tool", transform(vector(1.0, 2.0, 3.0), turn))
    two = replace(one, transform=transform(vector(1.0, 2.0, 3.5), turn))
    still, weight = vector(0.0, 0.0, 0.0), vector(0.0, 0.0, 9.8)
    imu = message_class("sensor_msgs/msg/Imu")(said("imu", 0), turn, nine, still, nine, weight, nine)
    many = message_class("tf2_msgs/msg/TFMessage")
    with BagWriter(folder / "second") as bag:
        bag._flushed = float("inf")  # never due: a case is the same on a busy machine
        for topic, kind, data, ns in messages(folder / "first"):
            bag.add_topic(topic, kind)
            bag.write_raw(topic, data, ns)
        for topic, kind, message in (
            ("/tf", "tf2_msgs/msg/TFMessage", many([two, one])),
            ("/tf", "tf2_msgs/msg/TFMessage", many([one])),
            ("/vrpn/pose", "geometry_msgs/msg/TransformStamped", one),
            ("/imu", "sensor_msgs/msg/Imu", imu),
        ):
            bag.write(topic, kind, message, 1_700_000_000_000_000_000 + len(str(message)))
    return next((folder / "second").glob("*.mcap")).read_bytes()


def mcap_target(folder: Path) -> Target:
    """Bags, read, inspected, and one in four repaired."""
    raw = bag_bytes(folder)
    base, file, counter = parts(raw), folder / "case.mcap", count(1)
    wishes = (Topics(), Topics(tf=("tracker", "tool")), Topics.of(["tracker/pose=/vrpn/pose"], ["/imu"]))

    def run(data: bytes) -> None:
        file.write_bytes(data)
        if (k := next(counter)) % 4 == 0:
            repair_bag(file, folder / f"repaired{k}")
            shutil.rmtree(folder / f"repaired{k}", ignore_errors=True)
        seen, chain = read_recording(file, topics=wishes[k % 3]), None
        if seen.robot_description is not None:
            with contextlib.suppress(ModcalError):
                chain = read_chain(seen.robot_description, None, None)
        inspect(seen, chain)

    return Target("mcap", lambda rng: mcap_case(base, raw, rng), run, raw)


def sqlite_target(folder: Path) -> Target:
    """SQLite bags with bytes changed, and with messages changed."""
    made, file, known = folder / "made.db3", folder / "case.db3", dict[str, int]()
    with contextlib.closing(sqlite3.connect(made)) as base:
        base.executescript(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT, "
            "offered_qos_profiles TEXT); CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, "
            "data BLOB);"
        )
        for topic, kind, data, ns in messages(folder / "for_sqlite"):
            if topic not in known:
                known[topic] = len(known) + 1
                base.execute("INSERT INTO topics VALUES(?, ?, ?, 'cdr', '')", (known[topic], topic, kind))
            base.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, ?)", (known[topic], ns, data))
        base.commit()
    raw = made.read_bytes()

    def make(rng: Rng) -> bytes:
        out = raw
        for _ in range(int(rng.integers(1, 6))):
            out = spoilt(out, rng)
        return out

    return Target("sqlite", make, lambda data: file.write_bytes(data) and inspect(read_recording(file)), raw)


def metadata_target(folder: Path) -> Target:
    """metadata.yaml of a folder, read and repaired by."""
    bag, anew = folder / "described", folder / "anew"
    write_recording(recording(), bag)
    metadata = bag / "metadata.yaml"

    def run(case: Any) -> None:
        metadata.write_text(yaml_text(case), encoding="utf-8")
        with contextlib.suppress(ModcalError):
            repair_bag(bag, anew)
        shutil.rmtree(anew, ignore_errors=True)
        read_recording(bag)

    return of_data("metadata", yaml.safe_load(metadata.read_text()), run)


def run_urdf(case: str) -> None:
    chain = read_chain(case, None, None)
    chain.reach()
    LoadedArm.read(case, chain.base, chain.tip)


def mapping_target(folder: Path) -> Target:
    """Mappings of import with a table as it should be, and tables that are not with the mapping as it should be."""
    base, rows = BASES["mapping"], folder / "rows.csv"
    ways = places(base)

    def make(rng: Rng) -> tuple[Any, str]:
        if rng.integers(4):
            return data_case(base, ways, rng), ROWS
        return base, text_case(ROWS, CSV_WORDS, rng)

    def run(case: tuple[Any, str]) -> None:
        mapping, text = case
        rows.write_text(text, encoding="utf-8", errors="surrogateescape")
        made = import_tables(mapping, folder, "mapping")
        shutil.rmtree(folder / "imported", ignore_errors=True)
        write_recording(made, folder / "imported")

    return Target("mapping", make, run, (base, ROWS))


def cell_target(folder: Path) -> Target:
    file = folder / "cell.yaml"

    def run(case: Any) -> None:
        file.write_text(yaml_text(case), encoding="utf-8")
        read_cell(file)
        read_topics(file, Topics())

    return of_data("cell", BASES["cell"], run)


def calibration() -> dict[str, Any]:
    """A calibration with effects and parameters, as data."""
    chain = read_chain(URDF, None, "tool0")
    effects = (
        Effect("latency", "tracker", JOINTS, "velocity", Shape("linear")).started(np.zeros(1)),
        Effect("compliance", "elbow_joint", "axis", "load:elbow_joint", Shape("linear")).started(np.zeros(1)),
    )
    model = Model(chain, ("tracker",), np.eye(4)[None], np.eye(4))
    ranges, parameters = np.array([[-1.0] * chain.n, [1.0] * chain.n]), (("elbow_joint/zero", 0.1, 0.01, "rad"),)
    more = {"postures": np.zeros((3, chain.n)), "watched": (1.0, 2.0), "ranges": {"temperature:a": (1.0, 2.0)}}
    whole = Calibration(model, replace(model, effects=effects), model, ranges, parameters, scatter=(1e-4, 1e-4), **more)
    return dict(parse_yaml(to_yaml(to_data(whole)), "calibration"))


def run_calibration(case: Any) -> None:
    """One that is read must predict, correct, and be written again."""
    read = from_data(case, "calibration.yaml")
    for model in (read.nominal, read.calibrated, read.geometric):
        model.predict(np.zeros((2, len(read.nominal.chain.names))))
    if isinstance(read.calibrated.chain, Chain):
        Correction(read)
    from_data(parse_yaml(to_yaml(to_data(read)), "again"), "again")


def report_target() -> Target:
    """report.json as the calibrator reads it back, and any JSON there."""
    base = {"modcal_report": 1, "status": "open", "open_because": ["a"], "remedy": "b", "verdict": "c"}
    base["error_mm"] = {"final": {}}
    ways, text = places(base), json.dumps(base)

    def make(rng: Rng) -> str:
        if rng.integers(3):
            return json.dumps(data_case(base, ways, rng), default=str)
        return text_case(text, JSON_WORDS, rng)

    return Target("report", make, standing_of, text)


def csv(data: Any) -> str:
    rows = data.get("rows") if isinstance(data, dict) else None
    lines = rows if isinstance(rows, list) else []
    return "\n".join(",".join(map(str, row)) if isinstance(row, list) else str(row) for row in lines)


def body_of(data: Any) -> Any:
    """What a fit asks of a body."""
    target = target_from_data(data, "target.yaml")
    return target.place_prior() if isinstance(target, MarkerBundle) else target.points


def other_files_target() -> Target:
    """Kinematic tables, assemblies, tasks of synthesis, sites of planning, plans, stores of modules, what belongs to a
    camera: one reader each.
    """
    names, body = read_chain(URDF, None, "tool0").names, target_from_data(BASES["files"]["body"], "target.yaml")
    example = lambda name: parse_yaml((EXAMPLES / name).read_text(), name)  # noqa: E731
    plan = {"modcal_plan": 1, "joints": list(names), "stations": [{"position": [0.0] * 6}] * 3}
    files = {
        "table": (example("robots/ur5.yaml"), from_table),
        "assembly": (
            example("modules/five_joints.yaml"),
            lambda data: assembly_from_data(data, published(), "assembly.yaml"),
        ),
        "synthesis": (example("synthesis/two_poses.yaml"), lambda data: task_from_data(data, "task.yaml")),
        "site": (example("planning/hall.yaml"), lambda data: site_from_data(data, "site.yaml")),
        "library": (parse_yaml(published_text(), "library"), lambda data: library_from_data(data, "library.yaml")),
        "plan": (plan, lambda data: stations_from_data(data, names, "plan.yaml")),
    }
    readers: dict[str, Run] = {
        "printed target": lambda data: target_from_data(data, "target.yaml"),
        "kalibr target": lambda data: target_from_data(data, "aprilgrid.yaml"),
        "body": body_of,
        "tag bundles": body_of,
        "corners": lambda data: corners_of(csv_cells(csv(data), "corners.csv"), body, "corners.csv"),
        "camera_info": lambda data: lens_from_data(data, "camera.yaml"),
        "joints": lambda data: joints_of(csv_cells(csv(data), "joints.csv"), ("a", "b"), "joints.csv"),
    }
    files |= {name: (BASES["files"][name], read) for name, read in readers.items()}
    ways, order = {name: places(base) for name, (base, _) in files.items()}, sorted(files)

    def make(rng: Rng) -> tuple[str, Any]:
        name = order[int(rng.integers(len(order)))]
        return name, data_case(files[name][0], ways[name], rng)

    return Target("others", make, lambda case: files[case[0]][1](case[1]), ("site", files["site"][0]))


_ENCODINGS = ("mono8", "rgb8", "bgra8", "bayer_rggb8", "yuv422", "8UC3", "16UC1", "", "bayer_x", "x" * 1000)
_SIDES = (0, 1, 2, 3, 7, 64, -1, 2**31 - 1)


def make_images(rng: Rng) -> tuple[Any, Any, Any]:
    """Messages with images, corners and lenses whose sizes, steps, offsets and bytes do not go together."""
    pick = lambda *values: int(rng.choice(values))  # noqa: E731
    stamp = SimpleNamespace(sec=int(rng.integers(-5, 5)), nanosec=int(rng.integers(10**9)))
    header = SimpleNamespace(stamp=stamp, frame_id="camera")
    width, height = (int(x) for x in rng.choice(_SIDES, 2))
    data = rng.integers(0, 255, pick(0, 1, 10, 64 * 64, 64 * 64 * 3, 64 * 64 * 4)).astype(np.uint8)
    about = {"header": header, "width": width, "height": height}
    step, encoding = pick(0, 1, width, 3 * width, 5, 2**31 - 1), str(rng.choice(_ENCODINGS))
    image = SimpleNamespace(**about, step=step, encoding=encoding, is_bigendian=0, data=data)
    names, fields = [*(CORNER.names or ()), "x"], []
    for i, name in enumerate(names):
        said = str(rng.choice(names)) if rng.random() < 0.05 else name
        offset = pick(1000, -4) if rng.random() < 0.05 else 4 * i
        kind = 6 if rng.random() < 0.05 or name.startswith(("id", "image")) else 7
        fields.append(SimpleNamespace(name=said, offset=offset, datatype=kind))
    about |= {"width": pick(0, 1, 4, 170, -1), "height": 1, "point_step": pick(0, 4, 24, 24, 24, 10**9)}
    corners = np.ones(4, CORNER)
    corners["id"] = rng.integers(0, 9, 4)
    held = corners.tobytes() if rng.random() < 0.5 else data.tobytes()
    cloud = SimpleNamespace(**about, fields=fields, is_bigendian=False, data=held)
    numbers = rng.choice([0.0, 1.0, 500.0, np.nan, np.inf, -3.0], pick(9, 9, 0, 4))
    model = str(rng.choice(["plumb_bob", "fisheye"]))
    return image, cloud, SimpleNamespace(width=width, height=height, k=numbers, d=numbers[:5], distortion_model=model)


def run_images(case: tuple[Any, Any, Any]) -> None:
    image, cloud, info = case
    if (raw := raw_image(image, 1.0)) is not None:
        grey_of(raw)
    if (data := lens_data(info)) is not None:
        with contextlib.suppress(ModcalError):
            lens_from_data(data, "camera_info")
    read_corners(cloud)


def targets(folder: Path) -> list[Target]:
    """All targets; folder: for files that cases are written to."""
    text = yaml_text(BASES["cell"]) + "a: &a {b: 1}\nc: {<<: *a, d: 2001-01-01}\n"
    return [
        *(mcap_target(folder), sqlite_target(folder), metadata_target(folder)),
        of_text("urdf", URDF, URDF_WORDS, run_urdf),
        *(mapping_target(folder), cell_target(folder)),
        of_data("calibration", calibration(), run_calibration),
        report_target(),
        of_text("yaml", text, YAML_WORDS, lambda case: parse_yaml(case, "f.yaml")),
        other_files_target(),
        Target("images", make_images, run_images, make_images(np.random.default_rng(0))),
    ]
