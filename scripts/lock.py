"""Writes requirements.txt, -test.txt and -interfaces.txt: every package, exact, the same on Python 3.11 and 3.12.

pip resolves the groups of pyproject.toml for an empty environment of the older interpreter; the newer one is then held
to the same versions and may only add packages. All files come from one resolution, so they never disagree. With each
version stand the hashes of all its files, for every kind of machine, as uv takes them from the index; pip then installs
nothing else. `--keep` keeps the versions and adds what is new in pyproject.toml; `--hashes` renews the hashes only.
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
UV = "uv==0.13.9"
FILES = ("requirements.txt", "requirements-test.txt", "requirements-interfaces.txt")
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


def hashed(lines: list[str]) -> str:
    """These pins with the hashes of their files, in the form that pip asks for."""
    with tempfile.TemporaryDirectory() as folder:
        here = Path(folder)
        subprocess.run([sys.executable, "-m", "venv", here / "venv"], check=True)
        subprocess.run([here / "venv/bin/python", "-m", "pip", "install", "--quiet", UV], check=True)
        (here / "pins.txt").write_text("\n".join(lines))
        command = [here / "venv/bin/uv", "--quiet", "--native-tls", "pip", "compile", "--no-deps", "--generate-hashes"]
        command += ["--no-annotate", "--no-header", "--universal", "--python-version", OLDER, here / "pins.txt"]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def pinned(name: str) -> list[str]:
    """The pins of a requirements file as it is, without hashes."""
    return re.findall(r"^[a-z0-9-]+==[^\s\\]+", (ROOT / name).read_text(), re.MULTILINE)


def resolved(held: dict[str, str]) -> tuple[list[str], list[str], list[str]]:
    """Pins of what is needed, of what only tests need, and of what builds the interfaces, which is an environment of
    its own: resolved on the older Python, completed on the newer.

    held: versions by name that are kept.
    """
    groups = tomllib.loads((ROOT / "pyproject.toml").read_text())["dependency-groups"]
    everything = resolve(OLDER, groups["runtime"] + groups["test"], held)
    everything |= resolve(NEWER, groups["runtime"] + groups["test"], everything)
    runtime = resolve(OLDER, groups["runtime"], everything) | resolve(NEWER, groups["runtime"], everything)
    test = {name: version for name, version in everything.items() if name not in runtime}
    wanted = groups["interfaces"]
    shared = {
        name: version for name, version in everything.items() if not any(w.startswith(f"{name}<") for w in wanted)
    }
    interfaces = resolve(OLDER, wanted, shared)
    interfaces |= resolve(NEWER, wanted, shared | interfaces)
    return pins(runtime), pins(test), pins(interfaces)


def main() -> None:
    """Writes the files."""
    present = tuple(pinned(name) if (ROOT / name).exists() else [] for name in FILES)
    held = dict(pin.split("==") for pin in present[0] + present[1]) if sys.argv[1:] == ["--keep"] else {}
    locks = present if sys.argv[1:] == ["--hashes"] else resolved(held)
    for name, lines in zip(FILES, locks, strict=True):
        (ROOT / name).write_text(HEADER + hashed(lines))
    print(
        f"modcal lock: {len(locks[0])} packages, {len(locks[1])} more for the tests, {len(locks[2])} for the interfaces"
    )


if __name__ == "__main__":
    main()
