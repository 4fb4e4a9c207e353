"""The assembly incidence matrix: which numbered link touches which joint, and how they are turned (Gao et al. 2014).

Columns are the joints in order, then the gripper; rows are the base and the kinds of link. An entry (link number, joint
number, turn) says that this link of its kind is bolted to that joint; of the two, the one nearer the gripper is turned
by so many quarter turns about z against the other. The gripper's number is 1. So the column of an inner joint has two
entries, of the link before it and the link behind it, and a link has two, in neighbouring columns; a link between
joints k and k + 1 is told from another of its kind by its number alone. Lengths are not in the matrix: they stand
beside it, for each numbered link.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from modcal_core.errors import BadTable
from modcal_core.modules.assembly import Assembly, Module
from modcal_core.modules.library import BASE, GRIPPER, JOINT, LINK, TURNS, Library


@dataclass(frozen=True)
class Entry:
    """One contact: number of the base or link among its kind, number of the joint or gripper, quarter turns."""

    link: int
    joint: int
    turn: int

    def __str__(self) -> str:
        return f"{self.link},{self.joint},{self.turn}"


@dataclass(frozen=True)
class Incidence:
    """An assembly incidence matrix with what stands beside it.

    columns: kinds of the joints, base to gripper, then of the gripper. rows: kinds of the base, then of links.
    entries: by (row, column), in the order of the arm. sizes: length codes by (row, number); serials: serial numbers by
    (row, number), the joints' and the gripper's by ("", column).
    """

    columns: tuple[str, ...]
    rows: tuple[str, ...]
    entries: Mapping[tuple[str, int], tuple[Entry, ...]]
    sizes: Mapping[tuple[str, int], int] = field(default_factory=dict)
    serials: Mapping[tuple[str, int], str] = field(default_factory=dict)

    def __str__(self) -> str:
        """The matrix as text, a row a line."""
        cells = [["", *self.columns]]
        for row in self.rows:
            said = [" ".join(map(str, self.entries.get((row, c), ()))) for c in range(len(self.columns))]
            cells.append([row, *(cell or "·" for cell in said)])
        widths = [max(len(line[c]) for line in cells) for c in range(len(cells[0]))]
        return "\n".join("  ".join(x.ljust(w) for x, w in zip(line, widths, strict=True)).rstrip() for line in cells)


def incidence_of(assembly: Assembly, library: Library) -> Incidence:
    """The matrix of an assembly that has been checked; links are numbered by kind from the base on."""
    rows = (assembly.modules[0].kind, *(t.name for t in library.of_role(LINK)))
    entries: dict[tuple[str, int], tuple[Entry, ...]] = {}
    sizes: dict[tuple[str, int], int] = {}
    serials: dict[tuple[str, int], str] = {}
    carriers = (assembly.modules[0], *assembly.links)
    touched = (*assembly.joints, assembly.modules[-1])
    count: dict[str, int] = {}

    def put(row: str, column: int, entry: Entry) -> None:
        entries[row, column] = (*entries.get((row, column), ()), entry)

    for i, carrier in enumerate(carriers):
        number = count[carrier.kind] = count.get(carrier.kind, 0) + 1
        sizes[carrier.kind, number] = carrier.size
        serials[carrier.kind, number] = carrier.serial
        serials["", i] = touched[i].serial
        if i > 0:
            put(carrier.kind, i - 1, Entry(number, i, carrier.turn))
        put(carrier.kind, i, Entry(number, i + 1 if i < assembly.n else 1, touched[i].turn))
    return Incidence(
        columns=tuple(m.kind for m in touched),
        rows=rows,
        entries=entries,
        sizes=sizes,
        serials={key: serial for key, serial in serials.items() if serial},
    )


def assembly_of(matrix: Incidence, library: Library, name: str = "modular_arm", source: str = "aim") -> Assembly:
    """The assembly that a matrix describes. Raises BadTable, one line, at the first fault."""
    n = len(matrix.columns) - 1
    _check_headings(matrix, library, source)
    contacts = _contacts(matrix, source)
    before, behind = _ways(matrix, contacts, source)
    _check_numbers(matrix, contacts, source)
    base = matrix.rows[0]
    modules = [_carrier(matrix, (base, 1), 0)]
    for c in range(n):
        modules.append(Module(matrix.columns[c], 0, before[c][1], matrix.serials.get(("", c), "")))
        modules.append(_carrier(matrix, *behind[c]))
    modules.append(Module(matrix.columns[n], 0, before[n][1], matrix.serials.get(("", n), "")))
    return Assembly(tuple(modules), name).checked(library, source)


_Key = tuple[str, int]  # kind of the row, and number among its kind


def _carrier(matrix: Incidence, key: _Key, turn: int) -> Module:
    return Module(key[0], matrix.sizes.get(key, 0), turn, matrix.serials.get(key, ""))


def _check_headings(matrix: Incidence, library: Library, source: str) -> None:
    if len(matrix.columns) < 2 or not matrix.rows:
        raise BadTable(source, "has no joints", "give columns: joints in order, then the gripper")
    for c, kind in enumerate(matrix.columns):
        role = library.type(kind, f"{source}: column {c + 1}").role
        wanted = GRIPPER if c == len(matrix.columns) - 1 else JOINT
        if role != wanted:
            raise BadTable(f"{source}: column {c + 1} ({kind})", f"is a {role}", f"use a {wanted} here")
    for r, kind in enumerate(matrix.rows):
        role = library.type(kind, f"{source}: row").role
        wanted = LINK if r else BASE
        if role != wanted:
            raise BadTable(f"{source}: row {kind}", f"is a {role}", "the first row is the base, all others are links")
    twice = [kind for r, kind in enumerate(matrix.rows) if kind in matrix.rows[:r]]
    if twice:
        raise BadTable(f"{source}: row {twice[0]}", "stands twice", "give each kind one row")


def _contacts(matrix: Incidence, source: str) -> dict[_Key, list[tuple[int, int]]]:
    """Columns and turns that each numbered base or link touches, each entry checked by itself."""
    n = len(matrix.columns) - 1
    contacts: dict[_Key, list[tuple[int, int]]] = {}
    for (row, column), entries in sorted(matrix.entries.items(), key=lambda item: item[0][1]):
        if row not in matrix.rows or not 0 <= column <= n:
            raise BadTable(f"{source}: entry at ({row}, {column + 1})", "is outside the matrix", "correct its place")
        for entry in entries:
            what = f"{source}: row {row}, column {column + 1}: {entry}"
            own = column + 1 if column < n else 1
            if entry.joint != own:
                said = f"names joint {entry.joint} in the column of " + (f"joint {own}" if column < n else "gripper 1")
                raise BadTable(what, said, f"write {entry.link},{own},{entry.turn}")
            if not 0 <= entry.turn < TURNS:
                raise BadTable(what, f"turn {entry.turn}, 0 to {TURNS - 1} are possible", "give quarter turns")
            if entry.link < 1:
                raise BadTable(what, f"number {entry.link}", "number from 1 on")
            contacts.setdefault((row, entry.link), []).append((column, entry.turn))
    return contacts


def _ways(
    matrix: Incidence, contacts: Mapping[_Key, list[tuple[int, int]]], source: str
) -> tuple[dict[int, tuple[_Key, int]], dict[int, tuple[_Key, int]]]:
    """By column: the base or link before that joint, and the link behind it, each with the turn of that contact."""
    n = len(matrix.columns) - 1
    base = matrix.rows[0]
    before: dict[int, tuple[_Key, int]] = {}
    behind: dict[int, tuple[_Key, int]] = {}

    def claim(table: dict[int, tuple[_Key, int]], column: int, key: _Key, turn: int, where: str) -> None:
        if column in table:
            (row, number), _ = table[column]
            said = f"{key[0]} {key[1]} and {row} {number} are both {where} it"
            raise BadTable(f"{source}: column {column + 1}", said, "leave one of them out")
        table[column] = key, turn

    for key, touched in contacts.items():
        columns = [c for c, _ in touched]
        what = f"{source}: {key[0]} {key[1]}"
        if key[0] == base:
            if key[1] != 1 or columns != [0]:
                raise BadTable(what, "the base touches joint 1 once, and nothing else", "write 1,1,turn in column 1")
            claim(before, 0, key, touched[0][1], "before")
            continue
        if len(touched) != 2 or columns[1] != columns[0] + 1:
            at = ", ".join(str(c + 1) for c in columns)
            raise BadTable(what, f"touches column {at}", "a link touches two neighbouring columns, once each")
        claim(behind, columns[0], key, touched[0][1], "behind")
        claim(before, columns[1], key, touched[1][1], "before")
    for c in range(n + 1):
        if c not in before:
            missing = f"{base} does not touch it" if c == 0 else "no link is before it"
            raise BadTable(f"{source}: column {c + 1}", missing, "add the entry")
        if c < n and c not in behind:
            raise BadTable(f"{source}: column {c + 1}", "no link is behind it", "add the entry")
    return before, behind


def _check_numbers(matrix: Incidence, contacts: Mapping[_Key, object], source: str) -> None:
    """Links of a kind are numbered without gaps, and what stands beside the matrix belongs to one of them."""
    for row in matrix.rows:
        numbers = sorted(number for kind, number in contacts if kind == row)
        if numbers != list(range(1, len(numbers) + 1)):
            said = f"has numbers {', '.join(map(str, numbers))}"
            raise BadTable(f"{source}: row {row}", said, f"number them 1 to {len(numbers)}")
    for key in (*matrix.sizes, *matrix.serials):
        if key[0] and key not in contacts:
            raise BadTable(f"{source}: {key[0]} {key[1]}", "is described but not in the matrix", "leave it out")
