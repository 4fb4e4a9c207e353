"""Draws exports, lets modcal propose a mapping for each, and counts: right, asked, less, wrong in silence.

    make bench NAME=imports ARGS="--first 2000 --seeds 120 --only plain"

plain: joints and a pose, in the formats of eight instruments. columns: more than that. others: plain tables with a
bad row, a zero up to 5° off, joints counted otherwise, a target for each row, or no common column.

A proposal is right when the recording that its mapping makes has the joints that were written, and poses that differ
from the true ones by fixed transforms only. It is asked when the mapping says that it cannot tell, or none is proposed.
less: a written column is not used, which the mapping states.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import harness

# isort: split
import columns
import exports
import others
from arms import FOLDER
from judging import columns_judged, judged

from modcal_core.errors import ModcalError
from modcal_core.robot import Robot
from modcal_msgs_py.tables import MeasuredArm, find, import_tables

TARGET, OUTCOMES, SEEDS = 0.95, ("right", "asked", "less", "wrong"), {"plain": 120, "columns": 60, "others": 90}


def one(task: harness.Task) -> harness.Result:
    """What came of one export."""
    plain = task["kind"] == "plain"
    with harness.scratch(task["keep"] and Path(task["keep"])) as folder:
        written = {"plain": exports, "columns": columns, "others": others}[task["kind"]].draw(task["seed"], folder)
        robot = Robot.from_urdf((FOLDER / f"{written.recorded.robot}.urdf").read_text())
        try:
            made = find(written.paths, MeasuredArm(robot.chain, None if plain else robot.inertias))
            if made.open:
                return {**written.about, "outcome": "asked", "said": "; ".join(made.open)[:300]}
            if task["kind"] != "columns":
                mapping = dict(made.mapping)
                whole = None if plain else import_tables(mapping, folder, "bench")
                said = judged(written, mapping, folder) if plain else others.judged(written, whole)
                return {**written.about, "outcome": "right" if said == "right" else "wrong", "said": said}
            outcome, said = columns_judged(written, dict(made.mapping), folder)
        except ModcalError as error:
            return {**written.about, "outcome": "asked", "said": f"refused: {error}"}
    return {**written.about, "outcome": outcome, "said": said}


def main() -> int:
    """Exit code: 0 where the target is met."""
    parser = harness.parser(__doc__, seeds=None, names=SEEDS)
    parser.add_argument("--keep", default=None, metavar="DIR", help="folder for the files")
    given = harness.parsed(parser)
    tasks = [
        {"kind": kind, "seed": given.first + k, "keep": given.keep}
        for kind in given.names
        for k in range(SEEDS[kind] if given.seeds is None else given.seeds)
    ]
    results = harness.each(one, tasks, given, lambda r: r["outcome"])
    harness.counts("Exports", results, "kind", "outcome", OUTCOMES)
    for r in results:
        if not r["failed"] and r["outcome"] != "right":
            harness.say(f"{r['kind']} {r['seed']}: {r['outcome']}: {r['said']}")
    targets = [
        (f"{kind}: {TARGET:.0%} right, none wrong", said.count("right") >= TARGET * len(said) and "wrong" not in said)
        for kind in given.names
        for said in [[r.get("outcome") for r in results if r["kind"] == kind]]
    ]
    return int(bool(harness.failures(results))) or harness.met(*targets)


if __name__ == "__main__":
    sys.exit(main())
