"""Imports point downwards only, and the mathematics needs neither ROS nor its files."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

SRC = Path(__file__).resolve().parents[2] / "ros2_ws" / "src"

# A layer may import from itself and from those before it; `top` are the files beside the layers, where the loop stands.
_LAYERS = (
    "lazy",
    "version",
    "errors",
    "files",
    "schema",
    "plain",
    "geometry",
    "robots",
    "measurements",
    "effects",
    "calibration",
    "hypotheses",
    "moves",
    "modules",
    "diagnosis",
    "online",
)
_ALSO = {"lazy", "errors", "files", "schema", "plain", "geometry", "robots", "measurements"}
LAYERS: dict[str, set[str]] = {layer: set(_LAYERS[: i + 1]) for i, layer in enumerate(_LAYERS)}
LAYERS["sentinel"] = LAYERS["moves"] | {"sentinel"}
LAYERS["claim"] = LAYERS["calibration"] | {"claim"}
LAYERS["correction"] = LAYERS["calibration"] | {"correction"}
LAYERS["camera"] = LAYERS["diagnosis"] | {"claim", "camera"}
LAYERS["articulation"] = _ALSO | {"articulation"}
LAYERS["impedance"] = _ALSO | {"articulation", "impedance"}
LAYERS["verdict"] = LAYERS["diagnosis"] | {"verdict"}
LAYERS["planning"] = LAYERS["verdict"] | {"claim", "planning"}
LAYERS["outcome"] = LAYERS["verdict"] | {"claim", "outcome"}
LAYERS["top"] = {*LAYERS, "top"}  # the pipeline: it returns data
LAYERS["report"] = {*LAYERS, "report"}  # what people and programs read of them
LAYERS["public"] = {*LAYERS, "public"}  # functions for users of the library; the verbs of the command stand above
_PUBLIC = {"__init__", "public"}

MODCAL = {"modcal_core", "modcal_msgs_py", "modcal_nodes"}
# What each layer of the core may import from outside, beyond NumPy, SciPy and the standard library ...
_PARSERS = {"lxml"}
OUTSIDE = {"robots/urdf": _PARSERS, "articulation/urdf": _PARSERS}
# ... and what only inside a function, so that importing the core stays quick and needs no plotting.
OUTSIDE_WHEN_CALLED = {
    "files": {"yaml"},
    "camera/": {"cv2"},
    "report/": {"jinja2", "yaml"},
    "modules/": {"yaml"},
}


@dataclass(frozen=True)
class Import:
    """One module that one line imports. `lazy`: only when a function is called, or for the type checker alone."""

    module: str
    line: int
    lazy: bool


def imports(source: str, package: str) -> Iterator[Import]:
    """Every import of the source of a module in `package`, names of `from` imports included, relative ones resolved."""

    def walk(node: ast.AST, lazy: bool) -> Iterator[Import]:
        if isinstance(node, ast.Import):
            yield from (Import(alias.name, node.lineno, lazy) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            here = package.split(".")
            base = here[: len(here) - node.level + 1] if node.level else []
            module = ".".join([*base, *([node.module] if node.module else [])])
            yield from (Import(f"{module}.{alias.name}", node.lineno, lazy) for alias in node.names)
        lazy = lazy or isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        lazy = lazy or (isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"))
        for child in ast.iter_child_nodes(node):
            yield from walk(child, lazy)

    yield from walk(ast.parse(source), lazy=False)


@cache
def files(package: str) -> dict[str, Path]:
    """Paths of a package's modules by their place in it, such as ``robots/chain.py``."""
    top = SRC / package / package
    return {path.relative_to(top).as_posix(): path for path in sorted(top.rglob("*.py"))}


@cache
def imports_of(package: str, place: str) -> list[Import]:
    inside = ".".join([package, *Path(place).parts[:-1]])
    return list(imports(files(package)[place].read_text(), inside))


def layer_of(place: str) -> str:
    first = Path(place).parts[0].removesuffix(".py")
    return "public" if first in _PUBLIC else first if first in LAYERS else "top"


def target_layer(module: str) -> str:
    parts = module.split(".")
    if len(parts) > 1 and parts[1] in _PUBLIC:
        return "public"
    return parts[1] if len(parts) > 1 and parts[1] in LAYERS else "top"


def layers_broken(place: str, found: list[Import]) -> list[str]:
    allowed = LAYERS[layer_of(place)]
    return [
        f"{place}:{i.line} imports {i.module}"
        for i in found
        if i.module.split(".")[0] == "modcal_core" and target_layer(i.module) not in allowed
    ]


def outsiders(place: str, found: list[Import]) -> list[str]:
    def granted(table: dict[str, set[str]]) -> set[str]:
        return {name for prefix, names in table.items() if place.startswith(prefix) for name in names}

    always = {"numpy", "scipy", "modcal_core"} | sys.stdlib_module_names | granted(OUTSIDE)
    when_called = always | granted(OUTSIDE_WHEN_CALLED)
    return [
        f"{place}:{i.line} imports {i.module}"
        for i in found
        if i.module.split(".")[0] not in (when_called if i.lazy else always)
    ]


def test_every_folder_of_the_core_is_a_known_layer() -> None:
    assert {Path(p).parts[0] for p in files("modcal_core") if "/" in p} <= set(LAYERS)


# Each rule looks at every file and names all that break it.
@pytest.mark.slow
def test_core_imports_point_downwards() -> None:
    broken = {place: layers_broken(place, imports_of("modcal_core", place)) for place in files("modcal_core")}
    assert len(broken) > 100
    assert not [line for lines in broken.values() for line in lines]


def _module(place: str) -> str:
    return ".".join(["modcal_core", *Path(place).with_suffix("").parts]).removesuffix(".__init__")


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Groups of modules that reach each other by their imports."""

    def reached(start: str) -> set[str]:
        seen: set[str] = set()
        todo = [start]
        while todo:
            for module in graph[todo.pop()] - seen:
                seen.add(module)
                todo.append(module)
        return seen

    far = {module: reached(module) for module in graph}
    groups = {tuple(sorted({n for n in far[m] if m in far[n]})) for m in graph if m in far[m]}
    return sorted(list(group) for group in groups)


@cache
def import_graph() -> dict[str, set[str]]:
    """Modules of the core and what each imports of it: at import, when a function is called, and for the type checker."""
    names = {_module(place): place for place in files("modcal_core")}
    graph: dict[str, set[str]] = {}
    for module, place in names.items():
        # a face only says where its names are; who asks it for one imports the file that has it
        found = set() if place.endswith("__init__.py") else {i.module for i in imports_of("modcal_core", place)}
        found = {shown().get(name, name) for name in found}
        graph[module] = {name if name in names else name.rpartition(".")[0] for name in found} & set(names) - {module}
    return graph


@cache
def shown() -> dict[str, str]:
    """The names that faces show, with the package before them, and where each of them is."""
    faces = [place for place in files("modcal_core") if place.endswith("__init__.py")]
    return {
        f"{_module(place)}.{i.module.rpartition('.')[2]}": i.module
        for place in faces
        for i in imports_of("modcal_core", place)
        if i.module.startswith("modcal_core.")
    }


def test_no_modules_of_the_core_import_each_other_in_a_circle() -> None:
    graph = import_graph()
    assert sum(map(len, graph.values())) > 500
    assert not circles(graph)
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == [["a", "b", "c"]]


def test_core_needs_only_numpy_and_scipy() -> None:
    broken = {place: outsiders(place, imports_of("modcal_core", place)) for place in files("modcal_core")}
    assert len(broken) > 100
    assert not [line for lines in broken.values() for line in lines]


def test_messages_know_no_node() -> None:
    roots = {
        (place, i.module.split(".")[0])
        for place in files("modcal_msgs_py")
        for i in imports_of("modcal_msgs_py", place)
    }
    assert len({place for place, _ in roots}) > 10
    assert not {(place, root) for place, root in roots if root in ("rclpy", "modcal_nodes")}


@pytest.mark.slow
def test_importing_the_core_loads_no_ros() -> None:
    modules = [
        ".".join(["modcal_core", *Path(place).with_suffix("").parts]).removesuffix(".__init__")
        for place in files("modcal_core")
    ]
    # A process of its own: here, other tests have loaded ROS already.
    program = "import importlib, sys\nfor m in sys.argv[1:]: importlib.import_module(m)\nprint(*sorted(sys.modules))"
    done = subprocess.run(
        [sys.executable, "-c", program, *modules],
        env={**os.environ, "PYTHONPATH": str(SRC / "modcal_core")},
        capture_output=True,
        text=True,
        check=True,
    )
    loaded = {name.split(".")[0] for name in done.stdout.split()}
    assert "modcal_core" in loaded
    foreign = {
        "rclpy",
        "rosbags",
        "mcap",
        "mcap_ros2",
        "matplotlib",
        "rosidl_runtime_py",
        "rosidl_parser",
        "ament_index_python",
    }
    assert not loaded & foreign
    assert not {name for name in loaded if name.endswith(("_msgs", "_interfaces", "_srvs"))}
    assert not loaded & (MODCAL - {"modcal_core"})


def test_the_rules_catch_what_they_forbid() -> None:
    upwards = "from modcal_core.calibration.fit import identify"
    assert layers_broken("robots/chain.py", list(imports(upwards, "modcal_core.robots")))
    assert layers_broken("robots/chain.py", list(imports("from ..loop import fit", "modcal_core.robots")))
    assert layers_broken("loop.py", list(imports("from modcal_core.report import summary", "modcal_core")))
    assert not layers_broken("public.py", list(imports("from modcal_core.report import Report", "modcal_core")))
    assert layers_broken("geometry/se3.py", list(imports("from modcal_core import robots", "modcal_core.geometry")))
    assert not layers_broken("loop.py", list(imports(upwards, "modcal_core")))
    assert outsiders("report/blocks.py", list(imports("import jinja2", "modcal_core.report")))
    assert not outsiders("report/blocks.py", list(imports("def draw():\n    import jinja2", "modcal_core.report")))
    assert outsiders("loop.py", list(imports("def f():\n    from sensor_msgs.msg import JointState", "modcal_core")))
    assert outsiders("loop.py", list(imports("if True:\n    import modcal_msgs_py", "modcal_core")))
