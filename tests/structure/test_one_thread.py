"""The command and every node have BLAS on one thread, whatever the environment asks for."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib.metadata import distribution

import pytest

from modcal_nodes.one_thread import VARIABLES

SAID = """
import numpy, scipy.linalg
from threadpoolctl import threadpool_info
pools = [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]
assert len(pools) > 1  # NumPy brings one, and SciPy another
print(*pools)
"""
NUMPY_FIRST = """
import numpy
from modcal_nodes.one_thread import limit_blas
limit_blas()
"""
COMMAND = """
import sys
from modcal_nodes.cli.main import main
sys.argv = ["modcal", "limits", "--help"]
try:
    main()
except SystemExit as end:
    assert end.code == 0
print("-----")
"""


def threads(program: str) -> set[str]:
    """Of every BLAS that is loaded by the end of a program, started where the environment asks for four."""
    asked = {**os.environ, **dict.fromkeys(VARIABLES, "4")}
    done = subprocess.run([sys.executable, "-c", program + SAID], env=asked, capture_output=True, text=True, check=True)
    return set(done.stdout.splitlines()[-1].split())


@pytest.mark.slow
@pytest.mark.parametrize("program", [COMMAND, "import modcal_nodes.nodes.corrector", NUMPY_FIRST])
def test_blas_has_one_thread(program: str) -> None:
    assert threads(program) == {"1"}


@pytest.mark.slow
@pytest.mark.skipif(len(os.sched_getaffinity(0)) == 1, reason="one core")
def test_without_the_limit_it_has_more() -> None:
    """Else the test above could not fail."""
    assert threads("") != {"1"}


def test_a_program_that_imports_modcal_is_left_alone() -> None:
    """Whose threads are its own matter."""
    ask = "import os, modcal, modcal_nodes; modcal.Robot; print(os.environ['OPENBLAS_NUM_THREADS'])"
    asked = {**os.environ, "OPENBLAS_NUM_THREADS": "4"}
    assert subprocess.run([sys.executable, "-c", ask], env=asked, capture_output=True, text=True).stdout == "4\n"


def test_every_executable_is_the_command_or_a_node() -> None:
    """Where both begin, BLAS is limited; what began elsewhere would be forgotten."""
    points = distribution("modcal-nodes").entry_points
    begins = {point.value for point in points if point.group == "console_scripts"}
    assert len(begins) > 10
    assert all(value.startswith(("modcal_nodes.nodes.", "modcal_nodes.cli.main:main")) for value in begins)
