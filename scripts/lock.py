"""Writes requirements.txt and requirements-test.txt: every package, exact, the same on Python 3.11 and 3.12.

pip resolves the groups of pyproject.toml for an empty environment of the older interpreter; the newer one is then held
to the same versions and may only add packages. Both files come from one resolution, so they never disagree. With each
version stand the hashes of the files that pip chose on either interpreter, of this kind of machine; pip installs
nothing else. Where they came from is not written down.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
OLDER, NEWER = "3.11", "3.12"
HEADER = "# Made by `make lock` from pyproject.toml; change it there.\n"


@dataclass(frozen=True)
class Pin:
    """One version of a package, and the SHA-256 of its files, sorted."""

    version: str
    hashes: tuple[str, ...] = ()


def resolve(python: str, wanted: list[str], held: dict[str, Pin]) -> dict[str, Pin]:
    """What pip would install for `wanted` by normalised name, with the `held` versions as constraints."""
    executable = shutil.which(f"python{python}")
    if executable is None:
        sys.exit(f"modcal lock: python{python}: not on PATH: the lock is resolved on {OLDER} and on {NEWER}")
    with tempfile.TemporaryDirectory() as folder:
        here = Path(folder)
        (here / "wanted.txt").write_text("\n".join(wanted))
        (here / "held.txt").write_text("\n".join(f"{name}=={pin.version}" for name, pin in held.items()))
        subprocess.run([executable, "-m", "venv", here / "venv"], check=True)
        command = [here / "venv/bin/python", "-m", "pip", "install", "--quiet", "--dry-run", "--ignore-installed"]
        command += ["--report", here / "report.json", "-r", here / "wanted.txt", "-c", here / "held.txt"]
        subprocess.run(command, check=True)
        report = json.loads((here / "report.json").read_text())
    return read_report(report)


def read_report(report: dict[str, Any]) -> dict[str, Pin]:
    """The pins in what pip reports of an installation."""
    out = {}
    for entry in report["install"]:
        name = re.sub(r"[-_.]+", "-", entry["metadata"]["name"]).lower()
        found = entry["download_info"].get("archive_info", {}).get("hashes", {}).get("sha256")
        out[name] = Pin(entry["metadata"]["version"], () if found is None else (found,))
    return out


def together(first: dict[str, Pin], second: dict[str, Pin]) -> dict[str, Pin]:
    """The pins of both, with the hashes of both. Ends where they are of different versions."""
    out = dict(first)
    for name, pin in second.items():
        if name in out and out[name].version != pin.version:
            sys.exit(f"modcal lock: {name}: {out[name].version} on {OLDER}, {pin.version} on {NEWER}: hold one of them")
        out[name] = Pin(pin.version, tuple(sorted({*pin.hashes, *(out[name].hashes if name in out else ())})))
    return out


def pins(found: dict[str, Pin]) -> list[str]:
    """Requirement lines, sorted by name, each with its hashes. Ends where one has none: pip would take none then."""
    bare = sorted(name for name, pin in found.items() if not pin.hashes)
    if bare:
        sys.exit(f"modcal lock: {', '.join(bare)}: pip reports no SHA-256: take them from an index that has them")
    return [
        " \\\n    ".join([f"{name}=={pin.version}", *(f"--hash=sha256:{digest}" for digest in pin.hashes)])
        for name, pin in sorted(found.items())
    ]


def main() -> None:
    """Resolves everything on the older Python, completes it on the newer, and splits off what only tests need."""
    groups = tomllib.loads((ROOT / "pyproject.toml").read_text())["dependency-groups"]
    everything = resolve(OLDER, groups["runtime"] + groups["test"], {})
    everything = together(everything, resolve(NEWER, groups["runtime"] + groups["test"], everything))
    needed = {*resolve(OLDER, groups["runtime"], everything), *resolve(NEWER, groups["runtime"], everything)}
    runtime = {name: pin for name, pin in everything.items() if name in needed}
    test = {name: pin for name, pin in everything.items() if name not in needed}
    (ROOT / "requirements.txt").write_text(HEADER + "\n".join(pins(runtime)) + "\n")
    (ROOT / "requirements-test.txt").write_text(HEADER + "\n".join(pins(test)) + "\n")
    print(f"modcal lock: {len(runtime)} packages, and {len(test)} more for the tests")


if __name__ == "__main__":
    main()
