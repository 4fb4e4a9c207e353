"""Other files that are fuzzed, one reader each, and messages with images."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from data_cases import case as data_case
from data_cases import places
from target import ROOT, URDF, Target

from modcal_core.camera.bundle import MarkerBundle
from modcal_core.camera.target_file import any_target_from_data, target_from_data
from modcal_core.errors import ModcalError
from modcal_core.files import parse_yaml
from modcal_core.modules.library_data import library_from_data, published, published_text
from modcal_core.modules.spec import assembly_from_data
from modcal_core.modules.synthesis_data import task_from_data
from modcal_core.planning.site import site_from_data
from modcal_core.planning.stations import stations_from_data
from modcal_core.robots.tables import from_table
from modcal_core.robots.urdf import read_chain
from modcal_msgs_py.corners import CORNER, read_corners
from modcal_msgs_py.images import lens_data, raw_image
from modcal_nodes.vision.corner_table import corners_of_text
from modcal_nodes.vision.grey import grey_of
from modcal_nodes.vision.images import joints_of_text, lens_from_data

PRINTED = {
    "modcal_target": 1, "type": "charuco", "columns": 7, "rows": 5, "square_m": 0.03, "marker_m": 0.022,
    "dictionary": "DICT_5X5_100", "first_id": 0,
    "rulers": {"x_m": 0.21, "y_m": 0.15, "measured_x_m": 0.209, "measured_y_m": 0.1501, "measured_std_m": 1e-4},
}  # fmt: skip
KALIBR = {"target_type": "aprilgrid", "tagCols": 6, "tagRows": 6, "tagSize": 0.088, "tagSpacing": 0.3}
BODY = {
    "modcal_target": 1, "type": "bundle", "name": "block", "tolerance_m": 1e-3, "tolerance_normal_m": 2e-4,
    "tolerance_rad": 0.01, "size_tolerance": 5e-4, "print_tolerance": 0.01, "corner_order": ["ul", "ur", "lr", "ll"],
    "markers": [
        {"id": 1, "size_m": 0.04, "xyz": [0.0, 0.0, 0.09], "rpy": [0.0, 0.0, 0.0]},
        {"id": 2, "size_m": 0.04, "xyz": [0.09, 0.0, 0.0], "quaternion": [0.0, 0.6, 0.0, 0.8]},
    ],
    "points": [{"id": 30, "xyz": [0.0, 0.05, 0.0]}],
}  # fmt: skip
TAGS = {"tag_bundles": [{"name": "block", "layout": [{"id": 1, "size": 0.04, "x": 0.1, "qw": 1.0}]}]}
CORNERS = {"rows": [["image", "marker", "corner", "u", "v", "width", "height"], ["1", 1, 0, 10, 20, 640, 480]]}
CAMERA = {
    "image_width": 640, "image_height": 480, "distortion_model": "plumb_bob",
    "camera_matrix": {"data": [500.0, 0.0, 320.0, 0.0, 500.0, 240.0, 0.0, 0.0, 1.0]},
    "distortion_coefficients": {"data": [0.1, 0.0, 0.0, 0.0, 0.0]},
}  # fmt: skip


def _csv(data: Any) -> str:
    """Rows as CSV, whatever they hold."""
    rows = data.get("rows") if isinstance(data, dict) else None
    return "\n".join(
        ",".join(map(str, row)) if isinstance(row, list) else str(row)
        for row in (rows if isinstance(rows, list) else [])
    )


def _body(data: Any) -> Any:
    """What a fit asks of a body."""
    target = any_target_from_data(data, "target.yaml")
    return target.place_prior() if isinstance(target, MarkerBundle) else target.points


def other_files_target() -> Target:
    """Deltas, kinematic tables, assemblies, tasks of synthesis, sites of planning, plans, stores of modules, what
    belongs to a camera.
    """
    readers: dict[str, tuple[Any, Callable[[Any], Any]]] = {}
    for name, path, read in (
        ("table", ROOT / "bench" / "fuzz" / "table.yaml", from_table),
        ("assembly", _example("modules"), lambda data: assembly_from_data(data, published(), "assembly.yaml")),
        ("synthesis", _example("synthesis"), lambda data: task_from_data(data, "task.yaml")),
        ("site", _example("planning"), lambda data: site_from_data(data, "site.yaml")),
    ):
        if path is not None and path.is_file():
            readers[name] = parse_yaml(path.read_text(), name), read
    readers["library"] = parse_yaml(published_text(), "library"), lambda data: library_from_data(data, "library.yaml")
    chain = read_chain(URDF.read_text(), None, "tool0")
    plan = {"modcal_plan": 1, "joints": list(chain.names), "stations": [{"position": [0.0] * 6}] * 3}
    readers["printed target"] = PRINTED, lambda data: target_from_data(data, "target.yaml")
    readers["kalibr target"] = KALIBR, lambda data: target_from_data(data, "aprilgrid.yaml")
    readers["body"] = BODY, _body
    readers["tag bundles"] = TAGS, _body
    body = any_target_from_data(BODY, "target.yaml")
    readers["corners"] = CORNERS, lambda data: corners_of_text(_csv(data), body, "corners.csv")
    readers["camera_info"] = CAMERA, lambda data: lens_from_data(data, "camera.yaml")
    rows = {"rows": [["image", "a", "b"], ["1.png", 0.1, 0.2], ["2.png", "0.3", 1e-3], ["3.png", -1, 2]]}
    readers["joints"] = rows, lambda data: joints_of_text(_csv(data), ("a", "b"), "joints.csv")
    readers["plan"] = plan, lambda data: stations_from_data(data, chain.names, "plan.yaml")
    ways = {name: places(base) for name, (base, _) in readers.items()}
    names = sorted(readers)

    def run(case: tuple[str, Any]) -> None:
        readers[case[0]][1](case[1])

    def make(rng: np.random.Generator) -> tuple[str, Any]:
        name = names[int(rng.integers(len(names)))]
        return name, data_case(readers[name][0], ways[name], rng)

    return Target("others", make, run)


_ENCODINGS = ("mono8", "rgb8", "bgra8", "bayer_rggb8", "yuv422", "8UC3", "16UC1", "", "bayer_x", "x" * 1000)
_SIDES = (0, 1, 2, 3, 7, 64, -1, 2**31 - 1)


def images_target() -> Target:
    """Messages with images, corners and lenses whose sizes, steps, offsets and bytes do not go together."""

    def make(rng: np.random.Generator) -> tuple[Any, Any, Any]:
        stamp = SimpleNamespace(sec=int(rng.integers(-5, 5)), nanosec=int(rng.integers(10**9)))
        header = SimpleNamespace(stamp=stamp, frame_id="camera")
        width, height = (int(x) for x in rng.choice(_SIDES, 2))
        size = int(rng.choice([0, 1, 10, 64 * 64, 64 * 64 * 3, 64 * 64 * 4]))
        data = rng.integers(0, 255, size).astype(np.uint8)
        step = int(rng.choice([0, 1, width, 3 * width, 5, 2**31 - 1]))
        image = SimpleNamespace(
            header=header, width=width, height=height, step=step, encoding=str(rng.choice(_ENCODINGS)), is_bigendian=0,
            data=data,
        )  # fmt: skip
        names = [*(CORNER.names or ()), "x"]
        fields = [
            SimpleNamespace(name=str(rng.choice(names)) if rng.random() < 0.1 else name,
                            offset=int(rng.choice([4 * i, 4 * i, 4 * i, 1000, -4])),
                            datatype=6 if rng.random() < 0.1 or name.startswith(("id", "image")) else 7)
            for i, name in enumerate(names)
        ]  # fmt: skip
        cloud = SimpleNamespace(
            header=header, fields=fields, width=int(rng.choice([0, 1, 4, 170, -1])), height=1,
            point_step=int(rng.choice([0, 4, 24, 24, 24, 10**9])), is_bigendian=False, data=data.tobytes(),
        )  # fmt: skip
        numbers = rng.choice([0.0, 1.0, 500.0, np.nan, np.inf, -3.0], int(rng.choice([9, 9, 0, 4])))
        info = SimpleNamespace(
            width=width,
            height=height,
            k=numbers,
            d=numbers[:5],
            distortion_model=str(rng.choice(["plumb_bob", "fisheye"])),
        )
        return image, cloud, info

    def run(case: tuple[Any, Any, Any]) -> None:
        image, cloud, info = case
        if (raw := raw_image(image, 1.0)) is not None:
            grey_of(raw)
        if (data := lens_data(info)) is not None:
            with contextlib.suppress(ModcalError):
                lens_from_data(data, "camera_info")
        read_corners(cloud)

    return Target("images", make, run)


def _example(folder: str) -> Path | None:
    return next(iter(sorted((ROOT / "examples" / folder).glob("*.yaml"))), None)
