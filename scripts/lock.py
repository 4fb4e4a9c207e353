"""Writes requirements.txt and requirements-test.txt: every package, exact, the same on Python 3.11 and 3.12.

pip resolves the groups of pyproject.toml for an empty environment of the older interpreter; the newer one is then held
to the same versions and may only add packages. Both files come from one resolution, so they never disagree.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
OLDER, NEWER = "3.11", "3.12"
HEADER = "# Made by `make lock` from pyproject.toml; change it there.\n"


def resolve(python: str, wanted: list[str], held: dict[str, str]) -> dict[str, str]:
    """Versions by normalised name of what pip would install for `wanted`, with the `held` versions as constraints."""
    executable = shutil.which(f"python{python}")
    if executable is None:
        sys.exit(f"modcal lock: python{python}: not on PATH: the lock is resolved on {OLDER} and on {NEWER}")
    with tempfile.TemporaryDirectory() as folder:
        here = Path(folder)
        (here / "wanted.txt").write_text("\n".join(wanted))
        (here / "held.txt").write_text("\n".join(pins(held)))
        subprocess.run([executable, "-m", "venv", here / "venv"], check=True)
        command = [here / "venv/bin/python", "-m", "pip", "install", "--quiet", "--dry-run", "--ignore-installed"]
        command += ["--report", here / "report.json", "-r", here / "wanted.txt", "-c", here / "held.txt"]
        subprocess.run(command, check=True)
        report = json.loads((here / "report.json").read_text())
    pairs = (entry["metadata"] for entry in report["install"])
    return {re.sub(r"[-_.]+", "-", m["name"]).lower(): m["version"] for m in pairs}


def pins(versions: dict[str, str]) -> list[str]:
    """Requirement lines, sorted by name."""
    return [f"{name}=={version}" for name, version in sorted(versions.items())]


def main() -> None:
    """Resolves everything on the older Python, completes it on the newer, and splits off what only tests need."""
    groups = tomllib.loads((ROOT / "pyproject.toml").read_text())["dependency-groups"]
    everything = resolve(OLDER, groups["runtime"] + groups["test"], {})
    everything |= resolve(NEWER, groups["runtime"] + groups["test"], everything)
    runtime = resolve(OLDER, groups["runtime"], everything) | resolve(NEWER, groups["runtime"], everything)
    test = {name: version for name, version in everything.items() if name not in runtime}
    (ROOT / "requirements.txt").write_text(HEADER + "\n".join(pins(runtime)) + "\n")
    (ROOT / "requirements-test.txt").write_text(HEADER + "\n".join(pins(test)) + "\n")
    print(f"modcal lock: {len(runtime)} packages, and {len(test)} more for the tests")


if __name__ == "__main__":
    main()
