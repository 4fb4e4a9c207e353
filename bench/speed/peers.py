"""Others that live in environments of their own, because their requirements do not go with ours, nor with each other's.

``make bench`` makes them from bench/requirements.txt. One that is not there is said in the table, and is no error.
"""

from __future__ import annotations

import json
import subprocess
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
ENVIRONMENTS = ROOT / ".venv-bench"


@dataclass(frozen=True)
class Answer:
    """What a peer took [ms], None where it could not be asked, and what is to be said of it. found: its solution."""

    ms: float | None
    remark: str = ""
    found: tuple[float, ...] = ()


def ask(peer: str, script: str, *arguments: str, seconds: float = 300.0) -> Answer:
    """What bench/peers/SCRIPT.py prints: {"ms": …, "remark": …, "found": […]}. peer: as in bench/requirements.txt."""
    python = ENVIRONMENTS / peer / "bin" / "python"
    if not python.exists():
        return Answer(None, "not installed")
    command = [str(python), str(ROOT / "bench" / "peers" / f"{script}.py"), *arguments]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=seconds)
    except subprocess.TimeoutExpired:
        return Answer(None, f"not done after {seconds:.0f} s")
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["failed"])[-1]
        return Answer(None, "not installed" if "ModuleNotFoundError" in last else last[:60])
    said = json.loads(done.stdout.strip().splitlines()[-1])
    return Answer(said["ms"], said.get("remark", ""), tuple(said.get("found", ())))
