"""`modcal examples`: what pages name, for those who have no checkout; and hashes of what is installed."""

from __future__ import annotations

import re
from importlib.metadata import PackagePath, PathDistribution
from pathlib import Path

import pytest

from modcal_nodes.cli.main import run

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), *sorted((ROOT / "docs" / "howto").glob("*.md"))]


def test_every_example_that_a_command_names_is_copied(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(["examples"]) == 0
    said = capsys.readouterr().out
    assert said.startswith("Written: bags (2 files), examples (")
    named = {
        name.rstrip(".")
        for page in PAGES
        for block in re.findall(r"^```(?:bash|console)\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)
        for name in re.findall(r"(?<![\w/.])(?:examples|bags)/[\w./]+", block)
    }
    assert len(named) > 12
    assert not {name for name in named if not Path(name).exists() and not name.endswith(".sh")}
    tried = [line.split()[1:] for line in said.splitlines() if line.startswith("  modcal ")]
    assert run(tried[0]) == 0
    assert len(tried) == 2


def test_nothing_is_written_over(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "examples").mkdir()
    assert run(["examples", str(tmp_path)]) == 2
    assert capsys.readouterr().err == (
        f"modcal: {tmp_path}/examples: is there already: give another folder: modcal examples FOLDER\n"
    )
    assert not (tmp_path / "bags").exists()
    assert run(["examples", str(tmp_path / "new")]) == 0
    assert f"Try in {tmp_path}/new:" in capsys.readouterr().out


def test_of_an_installation_only_what_was_shipped_is_copied(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """pip lists what it compiled, too; what is elsewhere in the installation is no example."""
    kept = tmp_path / "share" / "modcal" / "examples"
    for name in ("a.py", "__pycache__/a.cpython-312.pyc", "../../other/b.py"):
        (kept / name).parent.mkdir(parents=True, exist_ok=True)
        (kept / name).write_text("1")
    listed = [PackagePath(file.relative_to(tmp_path).as_posix()) for file in tmp_path.rglob("*.py*") if file.is_file()]
    for one in listed:
        one.dist = PathDistribution(tmp_path / "modcal.dist-info")
    monkeypatch.setattr("modcal_nodes.cli.examples.files", lambda name: listed)
    assert run(["examples", str(tmp_path / "here")]) == 0
    assert len(listed) == 3
    assert [file.name for file in (tmp_path / "here").rglob("*") if file.is_file()] == ["a.py"]


@pytest.mark.parametrize("name", ["requirements.txt", "requirements-test.txt"])
def test_every_requirement_has_hashes_and_no_address(name: str) -> None:
    text = (ROOT / name).read_text()
    parts = re.split(r"^(?=[a-z0-9-]+==)", text, flags=re.MULTILINE)[1:]
    assert len(parts) > 20
    assert all(re.search(r"--hash=sha256:[0-9a-f]{64}", part) for part in parts)
    assert "://" not in text
