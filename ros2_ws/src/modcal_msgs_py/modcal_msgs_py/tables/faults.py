"""What is wrong with rows of a table, collected, so that one message names them all."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

from modcal_core.errors import BadTable

_MAX_LINES, _MAX_KINDS = 20, 12  # that a message lists; more are counted


@dataclass
class Faults:
    """Faulty cells and missing ones of one file. skip: whether rows with missing cells are left out and counted."""

    file: str
    skip: bool = False
    _cells: dict[tuple[str, str], list[tuple[int, str]]] = field(default_factory=dict)
    _missing: dict[str, set[int]] = field(default_factory=dict)

    def bad(self, line: int, column: object, said: str, kind: str = "") -> None:
        """Note a cell that cannot be used. kind: what cells with the same fault have in common."""
        found = self._cells.setdefault((f"column {column}" if column is not None else "", kind or said), [])
        if all(line != seen for seen, _ in found[-1:]):
            found.append((line, said))

    def missing(self, lines: Iterable[int], what: str) -> None:
        """Note rows that lack something that is needed."""
        self._missing.setdefault(what, set()).update(lines)

    def require_none(self) -> None:
        """Raises BadTable that names all faulty rows with the reasons, if there are any."""
        told = [_told(column, cells) for (column, _), cells in self._cells.items()]
        rows = {line for cells in self._cells.values() for line, _ in cells}
        remedy = "correct the cells, or leave the rows out"
        if not self.skip:
            for what, lines in self._missing.items():
                told.append(f"{_lines(sorted(lines))}, {what}: no number")
                rows |= lines
            if self._missing:
                remedy = "correct the cells, leave the rows out, or state missing: skip"
        if not told:
            return
        more = f"; {len(told) - _MAX_KINDS} more reasons" if len(told) > _MAX_KINDS else ""
        count = f"{len(rows)} faulty rows: " if len(rows) > 1 else ""
        raise BadTable(self.file, f"{count}{'; '.join(told[:_MAX_KINDS])}{more}", remedy)

    def notes(self) -> list[str]:
        """A sentence for each reason why rows were left out."""
        return [
            f"{self.file}: {len(lines)} row{'s were' if len(lines) > 1 else ' was'} left out: no number in {what}."
            for what, lines in self._missing.items()
            if lines
        ]


def _told(column: str, cells: list[tuple[int, str]]) -> str:
    line, said = cells[0]
    also = f" (also {_lines([other for other, _ in cells[1:]])})" if len(cells) > 1 else ""
    return f"line {line}{', ' if column else ''}{column}: {said}{also}"


def _lines(lines: list[int]) -> str:
    more = f" and {len(lines) - _MAX_LINES} more" if len(lines) > _MAX_LINES else ""
    return f"line{'s' if len(lines) > 1 else ''} {', '.join(map(str, lines[:_MAX_LINES]))}{more}"
