"""Real arms, whole recordings: what the README's table says. Needs ../shared/data beside the checkout.

The tests run the same on as much of it as shows the claims (tests/test_real_data.py).
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT.parent / "shared" / "data"
BLOCKS = {"ipa_ur10_series_a": "200", "ipa_ur10_series_d": "10"}
SOCKETS = ("panda_3", "panda_4", "kuka_14")


def report_of(out: Path, *arguments: str) -> dict[str, Any]:
    """report.json of a verb; what it prints is dropped."""
    from modcal_nodes.cli.main import run

    with contextlib.redirect_stdout(io.StringIO()):
        code = run([*arguments, "--out", str(out)])
    if code not in (0, 3):
        sys.exit(f"modcal {' '.join(arguments)}: exit {code}")
    return dict(json.loads((out / "report.json").read_text()))


def imported(name: str, folder: Path) -> str:
    """The bag of a recording."""
    from modcal_nodes.cli.main import run

    with contextlib.redirect_stdout(io.StringIO()):
        if run(
            ["import", str(ROOT / f"examples/import/{name}.yaml"), "--data", str(DATA), "--out", str(folder / name)]
        ):
            sys.exit(f"{name} cannot be imported")
    return str(folder / name)


def row(name: str, report: dict[str, Any]) -> str:
    """Held-out RMS [mm] by stage, the status, and what the model contains."""
    sizes = "".join(f"{report['error_mm'][stage]['rms']:10.3f}" for stage in ("nominal", "geometric", "final"))
    effects = ", ".join(f"{e['family']} {e['place']}" for e in report["effects"])
    return f"{name:<34}{sizes}  {report['status']:<12}{effects}"


def main() -> None:
    """Print a row for each recording, as soon as it is known."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="recordings whose name holds this")
    only = parser.parse_args().only
    if not DATA.is_dir():
        sys.exit("no real recordings: ../shared/data is not beside this checkout")
    print(f"{'recording':<34}{'nominal':>10}{'geometric':>10}{'final':>10}  status      effects")
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        for name, block in BLOCKS.items():
            if only in name:
                bag = imported(name, folder)
                print(row(name, report_of(folder / f"{name}_out", "calibrate", bag, "--block", block)), flush=True)
        first, second = (folder / f"{name}_out" for name in BLOCKS)
        if first.is_dir() and second.is_dir():
            bag = str(folder / "ipa_ur10_series_d")
            frozen = report_of(folder / "frozen", "evaluate", str(first), bag, "--refit-base", "--refit-tool")
            print(row("series a, frozen, on series d", frozen), flush=True)
        for name in SOCKETS:
            if only in name:
                cell = str(ROOT / f"examples/import/mukca_{name}_cell.yaml")
                arguments = ("calibrate", imported(f"mukca_{name}", folder), "--tip", "ball_link", "--cell", cell)
                print(row(name, report_of(folder / f"{name}_out", *arguments, "--block", "1")), flush=True)


if __name__ == "__main__":
    main()
