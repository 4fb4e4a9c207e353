"""Ctrl-C at any moment of a verb that writes: what it was to write is not there, nor is anything else."""

from __future__ import annotations

import signal
import subprocess
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

from modcal_core.files import write_folder
from modcal_msgs_py.bag_files import appearing

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
MODCAL = ROOT / ".venv" / "bin" / "modcal"
ROWS = 15000
MAPPING = """
tables:
  - files: "many.csv"
    time: {seconds: t}
    joints: {unit: rad, columns: {one: q}}
    point: {frame: tracker, unit: m, position: [x, y, z]}
"""


def interrupted(folder: Path, *arguments: str | Path) -> tuple[int, str]:
    """(exit code, stderr) of a verb that is interrupted while it writes a bag; the folder must be as it was."""
    before = sorted(p.name for p in folder.iterdir())
    with subprocess.Popen(
        [MODCAL, *arguments], cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as done:
        until = time.monotonic() + 300.0
        while not any(folder.glob(".*/*/*.mcap")):
            assert done.poll() is None, "it was over before it could be interrupted"
            assert time.monotonic() < until
            time.sleep(3e-3)
        done.send_signal(signal.SIGINT)
        _, error = done.communicate(timeout=300)
    assert sorted(p.name for p in folder.iterdir()) == before
    return done.returncode, error.strip()


def test_import(tmp_path: Path) -> None:
    rows = "\n".join(f"{0.01 * i:.2f},{1e-4 * i:.4f},1,2,3" for i in range(ROWS))
    (tmp_path / "many.csv").write_text(f"t,q,x,y,z\n{rows}\n")
    (tmp_path / "mapping.yaml").write_text(MAPPING)
    assert interrupted(tmp_path, "import", "mapping.yaml", "--out", "bag") == (130, "")


class _Interrupted(Mapping[str, str]):
    """Two files, and Ctrl-C when the second one is asked for."""

    def __getitem__(self, name: str) -> str:
        if name == "two":
            raise KeyboardInterrupt
        return "1"

    def __iter__(self) -> Iterator[str]:
        return iter(("one", "two"))

    def __len__(self) -> int:
        return 2


@pytest.mark.parametrize("there", [False, True])
def test_a_folder_of_results_is_as_it_was(tmp_path: Path, there: bool) -> None:
    if there:
        (tmp_path / "out").mkdir()
        (tmp_path / "out" / "one").write_text("0")
    with pytest.raises(KeyboardInterrupt):
        write_folder(tmp_path / "out", _Interrupted())
    seen = {str(p.relative_to(tmp_path)): p.read_text() for p in tmp_path.rglob("*") if p.is_file()}
    assert seen == ({"out/one": "0"} if there else {})
    assert [p.name for p in tmp_path.iterdir()] == (["out"] if there else [])
    write_folder(tmp_path / "out", {"one": "1", "two": "2"})
    assert {p.name: p.read_text() for p in (tmp_path / "out").iterdir()} == {"one": "1", "two": "2"}


def test_a_folder_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "out"

    def half() -> None:
        with appearing(out) as stage:
            stage.mkdir()
            (stage / "half").write_text("")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        half()
    assert not list(out.parent.iterdir())
    with appearing(out) as stage:
        stage.mkdir()
        (stage / "whole").write_text("")
        assert not out.exists()
    assert [str(p.relative_to(tmp_path)) for p in out.parent.rglob("*")] == ["deep/out", "deep/out/whole"]
