"""Nothing in the repository depends on the machine it was written on."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

# Put together from pieces, so that this file does not hold what it looks for.
REGISTRIES = ["pypi" + ".org", "python" + "hosted.org", "deb.deb" + "ian.org", "registry.npm" + "js", "index" + "-url"]
MACHINE = [r"(?<![\w.])/" + name + r"/\w" for name in ("wo" + "rk", "ro" + "ot", "ho" + "me", "Us" + "ers")]
MACHINE += [r"(?<!\w)/t" + r"mp/w/", r"\.\./shared/sp" + "ec"]
MAX_BYTES = 2 * 2**20


def tracked() -> list[Path]:
    done = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True)
    if done.returncode != 0:
        pytest.skip("not a git checkout")
    return [ROOT / name for name in done.stdout.split("\0") if name and (ROOT / name).is_file()]


@pytest.mark.slow
@pytest.mark.parametrize("what", ["registries", "machine"])
def test_no_address_or_path_of_one_machine(what: str) -> None:
    wanted = re.compile("|".join(map(re.escape, REGISTRIES) if what == "registries" else MACHINE))
    found = []
    for path in tracked():
        text = path.read_bytes().decode(errors="ignore")
        found += [f"{path.relative_to(ROOT)}: {hit.group()}" for hit in wanted.finditer(text)]
    assert not found


def test_no_large_file() -> None:
    assert not [f"{p.relative_to(ROOT)}: {p.stat().st_size} bytes" for p in tracked() if p.stat().st_size > MAX_BYTES]


PINNED, HASHED = r"[a-z0-9-]+==[\w.+!]+", r"    --hash=sha256:[0-9a-f]{64}"


def test_lock_is_exact() -> None:
    for name in ("requirements.txt", "requirements-test.txt", "requirements-interfaces.txt"):
        lines = [line for line in (ROOT / name).read_text().splitlines() if line and not line.startswith("#")]
        assert lines
        assert not [line for line in lines if not re.fullmatch(rf"({PINNED}|{HASHED})( \\)?", line)]


def test_contributing_names_the_locked_versions() -> None:
    locked = set((ROOT / "requirements.txt").read_text().split())
    named = set(re.findall(r"[\w-]+==[\w.]+", (ROOT / "CONTRIBUTING.md").read_text()))
    assert named
    assert named <= locked
