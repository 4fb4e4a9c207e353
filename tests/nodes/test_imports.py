"""What a node does not need it does not import: each import is paid at every start."""

from __future__ import annotations

import subprocess
import sys

import pytest

DRAWING = {"matplotlib", "jinja2"}
COMPUTING = {"scipy.linalg", "scipy.special", "scipy.optimize"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("node", "unwanted"),
    [
        ("corrector", DRAWING | COMPUTING | {"mujoco", "mcap"}),
        ("simulated_cell", DRAWING | COMPUTING | {"ssl", "mcap"}),
        ("calibrator", DRAWING | {"mujoco", "mcap", "scipy.stats"}),
        ("station_runner", DRAWING | {"scipy.stats"}),
    ],
)
def test_a_node_imports_what_it_needs(node: str, unwanted: set[str]) -> None:
    code = f"import sys, modcal_nodes.nodes.{node}; print(*sorted(set(sys.modules) & {unwanted!r}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
