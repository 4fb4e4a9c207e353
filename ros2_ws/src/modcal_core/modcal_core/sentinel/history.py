"""An arm's recordings over months, on disk: a table in SQLite to which rows are added, and none is changed.

A row has a recording's cells, so that what is normal can be asked again as more of it becomes known, and what was said.
"""

from __future__ import annotations

import hashlib
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Literal

from modcal_core.errors import BadTable
from modcal_core.sentinel.cells import Cells, MonitoredArm
from modcal_core.sentinel.judging import NEWEST, ArmJudge, ArmVerdict
from modcal_core.sentinel.normal import Normal

FILE = "sentinel.db"
Role = Literal["reference", "later"]
_SCHEMA = """
CREATE TABLE IF NOT EXISTS bags (
    number INTEGER PRIMARY KEY, robot TEXT NOT NULL, name TEXT NOT NULL, began REAL NOT NULL, seconds REAL NOT NULL,
    role TEXT NOT NULL CHECK (role IN ('reference', 'later')), other_payload INTEGER NOT NULL, verdict TEXT NOT NULL,
    cells BLOB NOT NULL, UNIQUE (robot, name, began)
);
CREATE TRIGGER IF NOT EXISTS bags_kept BEFORE DELETE ON bags BEGIN SELECT RAISE(ABORT, 'rows are kept'); END;
CREATE TRIGGER IF NOT EXISTS bags_fixed BEFORE UPDATE ON bags BEGIN SELECT RAISE(ABORT, 'rows are fixed'); END;
"""


class BagHistory:
    """The recordings of one arm in a folder. Raises BadTable for a file that is no history, or of another arm."""

    def __init__(self, folder: Path, arm: MonitoredArm) -> None:
        """Begin or go on with the history in a folder."""
        said = "\n".join(arm.names).encode() + (b"" if arm.chain is None else arm.chain.digits())
        self._robot, self._path, self._arm = hashlib.sha256(said).hexdigest(), folder / FILE, arm
        folder.mkdir(parents=True, exist_ok=True)
        try:
            with closing(self._open()) as store, store:
                store.executescript(_SCHEMA)
                robots = {robot for (robot,) in store.execute("SELECT DISTINCT robot FROM bags")}
        except sqlite3.DatabaseError as error:
            raise BadTable(str(self._path), f"is no history ({error})", "give another folder") from error
        if robots and self._robot not in robots:
            raise BadTable(str(self._path), "is of another arm", "give each arm a folder of its own")

    def _open(self) -> sqlite3.Connection:
        return sqlite3.connect(self._path)

    def read(self, role: Role, newest: int = -1) -> list[tuple[Cells, bool]]:
        """The recordings of a role in order of time, and whether each carries another payload than the reference.

        newest: how many at most; negative: all.
        """
        asked = "SELECT name, began, seconds, cells, other_payload FROM bags WHERE robot = ? AND role = ?"
        with closing(self._open()) as store:
            rows = store.execute(f"{asked} ORDER BY began DESC LIMIT ?", (self._robot, role, newest)).fetchall()
        return [(Cells.from_bytes(*row[:4]), bool(row[4])) for row in reversed(rows)]

    def judged(self, later: list[tuple[Cells, bool]], every: bool = True) -> ArmVerdict:
        """Judge later recordings beside those that are kept, and keep them. later: each, and whether it is declared to
        carry another payload. every: whether all that are kept are looked at, for their trends, or what is judged only.
        """
        judge = ArmJudge(Normal.fit([cells for cells, _ in self.read("reference")], self._arm))
        now = {(cells.name, cells.began) for cells, _ in later}
        kept = [
            pair for pair in self.read("later", -1 if every else NEWEST) if (pair[0].name, pair[0].began) not in now
        ]
        found = judge.judged([judge.hear(*pair) for pair in (*kept, *later)])
        for cells, other in later:
            self.add([cells], "later", other, found.sentence)
        return found

    def add(self, bags: list[Cells], role: Role, other_payload: bool = False, verdict: str = "") -> None:
        """Add recordings; one that is there already stays as it is. verdict: what was said of the last of them."""
        rows = [(self._robot, c.name, c.began, c.seconds, role, other_payload, verdict, c.to_bytes()) for c in bags]
        columns = "robot, name, began, seconds, role, other_payload, verdict, cells"
        with closing(self._open()) as store, store:
            store.executemany(f"INSERT OR IGNORE INTO bags ({columns}) VALUES (?, ?, ?, ?, ?, ?, ?, ?)", rows)
