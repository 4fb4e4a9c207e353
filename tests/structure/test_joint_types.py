"""Nothing outside a joint type's own file asks for its name; the built-in types are registered as a package's is."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

from modcal_core.articulation.joint_motion import ArticulationModel
from modcal_core.articulation.models import registry

SRC = Path(__file__).resolve().parents[2] / "ros2_ws" / "src"
CORE = SRC / "modcal_core" / "modcal_core"
NAMES = {model.name for model in registry.BUILT_IN}
# Where joints of objects are met; robots' own joints bear the same words as URDF has them.
READ = [
    *(CORE / "articulation").glob("*.py"),
    *(CORE / "impedance").glob("*.py"),
    CORE / "articulation" / "models" / "registry.py",
    CORE / "report" / "articulation.py",
    SRC / "modcal_msgs_py" / "modcal_msgs_py" / "objects.py",
    SRC / "modcal_msgs_py" / "modcal_msgs_py" / "setpoints.py",
    SRC / "modcal_nodes" / "modcal_nodes" / "nodes" / "articulation_estimator.py",
    SRC / "modcal_nodes" / "modcal_nodes" / "cli" / "doors.py",
]


def named(source: str, names: set[str]) -> Iterator[int]:
    """Lines of texts that are one of these names, wherever they stand, but as URDF's own words."""
    tree = ast.parse(source)
    of_urdf = {
        id(a) for n in ast.walk(tree) if isinstance(n, ast.Call) and ast.unparse(n.func) == "InUrdf" for a in n.args
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and node.value in names and id(node) not in of_urdf:
            yield node.lineno


def test_no_joint_type_is_asked_for_by_name() -> None:
    assert len(READ) > 20
    found = [(file.name, line) for file in READ if file.exists() for line in named(file.read_text(), NAMES)]
    assert not found


def test_each_type_is_named_by_its_own_file_only() -> None:
    for model in registry.BUILT_IN:
        for file in (CORE / "articulation" / "models").glob("*.py"):
            if file.stem != model.name:
                assert not list(named(file.read_text(), {model.name})), (file.name, model.name)


def test_the_houses_types_pass_what_a_packages_must() -> None:
    assert all(isinstance(model, ArticulationModel) for model in registry.BUILT_IN)
    assert sum(model.share for model in registry.BUILT_IN) == 1.0
    assert not [fault for model in registry.BUILT_IN if model.moves and (fault := registry._fault(model))]


def test_the_rule_catches_a_ladder() -> None:
    ladder = "def f(kind):\n    return 1 if kind == 'screw' else {'rigid': 2}[kind]\n"
    assert list(named(ladder, NAMES)) == [2, 2]
