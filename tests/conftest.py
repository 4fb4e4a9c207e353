"""What every test gets: quiet threads, a ROS that stays on this machine, and the places of data and workspace."""

from __future__ import annotations

import gc
import os
import signal
import sys
import tempfile
from collections import Counter
from itertools import zip_longest
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
INSTALL = ROOT / "ros2_ws" / "install"
PACKAGES = ("modcal_core", "modcal_msgs_py", "modcal_nodes")

# A shell that runs the tests in the background may have them ignore Ctrl-C, which tests send to what they start.
signal.signal(signal.SIGINT, signal.default_int_handler)

# Set before NumPy or rclpy is imported, and inherited by every process that a test starts.
for _name in (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "BLIS_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
):
    os.environ.setdefault(_name, "1")
os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
# Without it an int in a float64 field is sent as another number, in silence.
os.environ.setdefault("ROS_PYTHON_CHECK_FIELDS", "1")
os.environ.setdefault("ROS_LOG_DIR", str(Path(tempfile.gettempdir()) / "modcal_ros_log"))
# As `source install/setup.bash` would have it, so that share directories are found without sourcing.
_prefixes = [*(str(INSTALL / p) for p in PACKAGES), sys.prefix, os.environ.get("AMENT_PREFIX_PATH", "")]
os.environ["AMENT_PREFIX_PATH"] = os.pathsep.join(p for p in _prefixes if p)

import numpy as np  # noqa: E402
import pytest  # noqa: E402
from hypothesis import settings  # noqa: E402

# The same examples on every run, and no deadline: a busy machine is not a failure.
settings.register_profile("modcal", derandomize=True, deadline=None, print_blob=True)
settings.load_profile("modcal")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--seed", type=int, default=7, help="seed of the rng fixture")


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Twice as many workers as cores, for tests of nodes mostly wait for what is played in real time; else as many."""
    cores = len(os.sched_getaffinity(0))
    return cores if "not dds" in config.option.markexpr else max(2, 2 * cores)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files that wait and slow ones that compute take turns, so that neither cores nor time lie idle; long ones first.

    Where CI runs, a machine that others use as well, what talks over DDS has a second try, which the summary tells of.
    """
    waits, computes, small = Counter[Path](), Counter[Path](), Counter[Path]()
    for item in items:
        dds, slow = (item.get_closest_marker(name) is not None for name in ("dds", "slow"))
        if dds and os.environ.get("CI"):
            item.add_marker(pytest.mark.flaky(reruns=1))
        (waits if dds else computes if slow else small)[item.path] += 5 if dds and slow else 1
    kinds = ([path for path, _ in kind.most_common()] for kind in (waits, computes))
    turns = [path for pair in zip_longest(*kinds) for path in pair if path is not None]
    place = {path: i for i, path in enumerate(dict.fromkeys([*turns, *small]))}
    items.sort(key=lambda item: place[item.path])


def pytest_collection_finish() -> None:
    """What was collected stays until the end: looking through it for garbage again and again takes a twentieth of the run."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000)


def pytest_report_header(config: pytest.Config) -> str:
    return f"seed: {config.getoption('--seed')}"


@pytest.fixture
def rng(request: pytest.FixtureRequest) -> np.random.Generator:
    """Random numbers, the same for every test and run unless --seed says otherwise."""
    return np.random.default_rng(request.config.getoption("--seed"))


@pytest.fixture(scope="session")
def root() -> Path:
    """Folder of the checkout."""
    return ROOT


@pytest.fixture(scope="session")
def install() -> Path:
    """Folder of the built workspace; `make test` builds it."""
    if not (INSTALL / "setup.bash").is_file():
        pytest.skip("the workspace is not built: run `make build`")
    return INSTALL


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the real recordings, which lies beside the checkout and is no part of it."""
    folder = ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("no real recordings: ../shared/data is not beside this checkout")
    return folder
