"""Assemblies as numbers, in the published code (Gao et al. 2014): what a search cuts, mixes and changes.

A base is [length, turn], 3 and 2 bits, the turn being that of the first joint on it. Every further sub-assembly is a
joint with its link, [joint, turn, link, length, turn], 1, 2, 2, 3 and 2 bits: the first turn is that of the link on the
joint, the second that of whatever comes next on the link. Written out: ``00001 0·01·10·100·00 …``. Read as whole
numbers, a base is one of 32 and a sub-assembly, called a *gene* here, one of 1024; an arm of n joints is n + 1 of them.

The kinds behind the codes, and the lengths, are the library's. One with more than two kinds of joint has one more bit
for them; a code that no module has makes a gene that cannot be built.

In the assembly incidence matrix columns are the joints in order, then the gripper; rows are the base and the kinds of
link. An entry (link number, joint number, turn) says that this link of its kind is bolted to that joint; of the two,
the one nearer the gripper is turned by so many quarter turns about z against the other. The gripper's number is 1. So
the column of an inner joint has two entries, of the link before it and the link behind it, and a link has two, in
neighbouring columns; a link between joints k and k + 1 is told from another of its kind by its number alone. Lengths
are not in the matrix: they stand beside it, for each numbered link.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.errors import BadTable, refusing
from modcal_core.modules.library import BASE, GRIPPER, JOINT, LINK, SIZES, TURNS, Assembly, Library, Module, ModuleType

BASES = SIZES * TURNS
FIELDS = ("joint", "turn", "link", "length", "next turn")
DOT = "·"


@dataclass(frozen=True)
class Coding:
    """The code of a library's assemblies. A genome is (n + 1,) whole numbers: the base, then a gene for every joint."""

    library: Library

    @cached_property
    def joints(self) -> tuple[ModuleType | None, ...]:
        """Kinds of joint by code; None where no module has it."""
        return self._by_code(JOINT, 1)

    @cached_property
    def links(self) -> tuple[ModuleType | None, ...]:
        """Kinds of link by code; None where no module has it."""
        return self._by_code(LINK, 2)

    def _by_code(self, role: str, bits: int) -> tuple[ModuleType | None, ...]:
        kinds = {t.code: t for t in self.library.of_role(role)}
        bits = max(bits, int(max(kinds)).bit_length())
        return tuple(kinds.get(code) for code in range(2**bits))

    @cached_property
    def shape(self) -> tuple[int, int, int, int, int]:
        """How many codes each field of a gene has, in the order of ``FIELDS``."""
        return len(self.joints), TURNS, len(self.links), SIZES, TURNS

    @property
    def genes(self) -> int:
        """How many genes there are, buildable or not."""
        return int(np.prod(self.shape))

    def fields(self, genes: ArrayLike) -> np.ndarray:
        """The five fields of genes (...), (5, ...)."""
        return np.stack(np.unravel_index(np.asarray(genes), self.shape))

    @cached_property
    def buildable(self) -> np.ndarray:
        """Whether the library has the joint, the link and its length, for every gene, (genes,)."""
        joint, _, link, size, _ = self.fields(np.arange(self.genes))
        sizes = np.array([0 if kind is None else kind.sizes for kind in self.links])
        return np.array([kind is not None for kind in self.joints])[joint] & (size < sizes[link])

    @cached_property
    def base_buildable(self) -> np.ndarray:
        """Whether the library has the base's length, (32,)."""
        return np.arange(BASES) // TURNS < self.library.base.sizes

    def assembly(self, genome: Sequence[int] | np.ndarray, name: str = "modular_arm") -> Assembly:
        """The assembly of a genome, checked. Raises BadTable where the library lacks a module or a length."""
        parts = []
        for k, gene in enumerate(genome[1:]):
            joint, turn, link, size, next_turn = (int(f) for f in self.fields(int(gene)))
            kinds = self.joints[joint], self.links[link]
            if kinds[0] is None or kinds[1] is None:
                remedy = "use a code that the library has"
                raise BadTable(f"code {self.gene_text(int(gene))} of joint {k + 1}", "no module has it", remedy)
            parts.append((kinds[0].name, turn, kinds[1].name, size, next_turn))
        base = int(genome[0]) // TURNS, int(genome[0]) % TURNS
        ends = self.library.base.name, self.library.gripper.name
        return Assembly.build(base, parts, *ends, name=name).checked(self.library, name)

    def genome(self, assembly: Assembly) -> np.ndarray:
        """The genome (n + 1,) of an assembly that has been checked; its name and serial numbers are not in it."""
        turns = [m.turn for m in assembly.modules]
        out = [assembly.modules[0].size * TURNS + turns[1]]
        for k, (joint, link) in enumerate(zip(assembly.joints, assembly.links, strict=True)):
            kinds = self.library.types[joint.kind], self.library.types[link.kind]
            fields = (kinds[0].code, turns[2 * k + 2], kinds[1].code, link.size, turns[2 * k + 3])
            out.append(int(np.ravel_multi_index(fields, self.shape)))
        return np.array(out)

    @cached_property
    def _widths(self) -> tuple[int, ...]:
        return tuple((count - 1).bit_length() for count in self.shape)

    def gene_text(self, gene: int) -> str:
        """A gene in bits, such as ``0·01·10·100·00``."""
        return DOT.join(f"{int(f):0{w}b}" for f, w in zip(self.fields(gene), self._widths, strict=True))

    def text(self, genome: Sequence[int] | np.ndarray) -> str:
        """A genome in bits: the base, then the genes, with spaces between."""
        return " ".join([f"{int(genome[0]):05b}", *(self.gene_text(int(g)) for g in genome[1:])])

    def parse(self, text: str) -> np.ndarray:
        """The genome (n + 1,) of a text in bits; dots may be left out. Raises BadTable."""
        words = text.replace(DOT, "").replace(".", "").split()
        wide = sum(self._widths)
        for k, word in enumerate(words):
            length = wide if k else 5
            if len(word) != length or set(word) - {"0", "1"}:
                what = f"code of joint {k}" if k else "code of the base"
                raise BadTable(f"{what} '{word}'", f"is not {length} bits", "write 00001 0·01·10·100·00 …")
        if len(words) < 2:
            raise BadTable(f"code '{text}'", "has no joint", "write 00001 0·01·10·100·00 …")
        return np.array([int(word, 2) for word in words])

    def lines(self, genome: Sequence[int] | np.ndarray) -> list[str]:
        """What a person reads: a line for the base and each joint with its link; lengths in mm, turns in degrees."""
        size, turn = divmod(int(genome[0]), TURNS)
        out = [f"{int(genome[0]):05b}: {_sized(self.library.base, size)}, {90 * turn}°"]
        for gene in genome[1:]:
            joint, turn, link, size, next_turn = (int(f) for f in self.fields(int(gene)))
            kinds = self.joints[joint], self.links[link]
            names = "-" if kinds[0] is None else kinds[0].name, "-" if kinds[1] is None else _sized(kinds[1], size)
            out.append(f"{self.gene_text(int(gene))}: {names[0]}, {90 * turn}°, {names[1]}, {90 * next_turn}°")
        return out


def _sized(kind: ModuleType, size: int) -> str:
    return f"{kind.name} {1e3 * kind.length(size):.10g} mm"


# --- The assembly incidence matrix


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


# --- An assembly from plain data, as its YAML file holds it (a list of modules, or an incidence matrix), and back

FORMAT = 1
_SEE = "see docs/modules.md"
_DEGREES = {90: 1, 180: 2, 270: 3}


@refusing
def assembly_from_data(data: Any, library: Library, source: str) -> Assembly:
    """The assembly that nested mappings and lists describe, checked against the library. Raises BadTable.

    Where both a list of modules and a matrix are given, they must say the same.
    """
    if not isinstance(data, Mapping) or data.get("modcal_assembly") != FORMAT:
        raise BadTable(source, f"is not an assembly (modcal_assembly: {FORMAT})", _SEE)
    unknown = [str(k) for k in data if k not in ("modcal_assembly", "name", "library", "modules", "aim")]
    if unknown:
        keys = "keys are modcal_assembly, name, library, modules, aim"
        raise BadTable(f"{source}: {unknown[0]}", "does not belong there", keys)
    name = plain_name(data.get("name", "modular_arm"), source)
    if "modules" not in data and "aim" not in data:
        raise BadTable(source, "names no modules", "give modules: or aim:")
    listed = matrix = None
    if "modules" in data:
        listed = Assembly(_modules(data["modules"], source), name).checked(library, source)
    if "aim" in data:
        matrix = assembly_of(_incidence(data["aim"], f"{source}: aim"), library, name, f"{source}: aim")
    if listed is not None and matrix is not None and listed != matrix:
        pairs = enumerate(zip(listed.modules, matrix.modules, strict=False))
        first = next((i for i, (a, b) in pairs if a != b), min(len(listed.modules), len(matrix.modules)))
        raise BadTable(source, f"modules and aim differ from module {first + 1} on", "leave one of them out")
    made = listed or matrix
    assert made is not None
    return made


def assembly_to_data(assembly: Assembly, library: Library) -> dict[str, Any]:
    """The assembly as a list of modules and as its matrix; reading it gives the same assembly."""
    matrix = incidence_of(assembly, library)
    aim: dict[str, Any] = {"columns": list(matrix.columns), "rows": {}}
    for row in matrix.rows:
        cells = [" ".join(map(str, matrix.entries.get((row, c), ()))) for c in range(len(matrix.columns))]
        aim["rows"][row] = cells
    aim["sizes"] = {row: _numbered(matrix.sizes, row) for row in matrix.rows if _numbered(matrix.sizes, row)}
    if matrix.serials:
        aim["serials"] = {row: _numbered(matrix.serials, row, matrix.sizes) for row in aim["sizes"]}
        aim["serials"]["columns"] = [matrix.serials.get(("", c), "") for c in range(len(matrix.columns))]
    return {
        "modcal_assembly": FORMAT,
        "name": assembly.name,
        "modules": [_module_to_data(m, i > 0) for i, m in enumerate(assembly.modules)],
        "aim": aim,
    }


def _module_to_data(module: Module, turned: bool) -> dict[str, Any]:
    out: dict[str, Any] = {"module": module.kind}
    if module.size:
        out["length"] = module.size
    if turned:
        out["turn"] = 90 * module.turn
    if module.serial:
        out["serial"] = module.serial
    return out


def _numbered(
    table: Mapping[tuple[str, int], Any], row: str, like: Mapping[tuple[str, int], Any] | None = None
) -> list:
    """Values of one row in the order of their numbers; those of ``like`` that are missing are empty."""
    numbers = sorted(number for kind, number in (like or table) if kind == row)
    return [table.get((row, number), "") for number in numbers]


def _modules(stated: Any, source: str) -> tuple[Module, ...]:
    if not isinstance(stated, Sequence) or isinstance(stated, str):
        raise BadTable(f"{source}: modules", "is not a list", _SEE)
    out = []
    for i, item in enumerate(stated):
        what = f"{source}: module {i + 1}"
        if not isinstance(item, Mapping) or "module" not in item:
            raise BadTable(what, "is not a mapping with the key module", "write {module: JR, turn: 90}")
        unknown = [str(k) for k in item if k not in ("module", "length", "turn", "serial")]
        if unknown:
            raise BadTable(f"{what}: {unknown[0]}", "does not belong there", "keys are module, length, turn, serial")
        turn = _turn(item.get("turn", 0), what)
        out.append(Module(str(item["module"]), item.get("length", 0), turn, _serial(item.get("serial"), what)))
    return tuple(out)


def _turn(stated: Any, what: str) -> int:
    """Quarter turns from degrees; 0 … 3 are quarter turns already."""
    if isinstance(stated, bool) or not isinstance(stated, int) or (stated not in _DEGREES and not 0 <= stated <= 3):
        raise BadTable(f"{what}: turn {stated!r}", "is not one of the four possible turns", "give 0, 90, 180 or 270")
    return _DEGREES.get(stated, stated)


def _serial(stated: Any, what: str) -> str:
    if stated is None:
        return ""
    if not isinstance(stated, str | int) or isinstance(stated, bool) or not str(stated).strip():
        raise BadTable(f"{what}: serial {stated!r}", "is not a text", "give the number on the module")
    return str(stated).strip()


def plain_name(stated: Any, source: str) -> str:
    """A name that is one plain word. Raises BadTable."""
    name = str(stated)
    if not name or not all(c.isalnum() or c in "_-." for c in name):
        raise BadTable(f"{source}: name '{name}'", "is not a plain word", "use letters, digits, _ and -")
    return name


def _incidence(stated: Any, what: str) -> Incidence:
    if not isinstance(stated, Mapping) or not {"columns", "rows"} <= set(stated):
        raise BadTable(what, "needs columns and rows", _SEE)
    unknown = [str(k) for k in stated if k not in ("columns", "rows", "sizes", "serials")]
    if unknown:
        raise BadTable(f"{what}: {unknown[0]}", "does not belong there", "keys are columns, rows, sizes, serials")
    columns, rows = stated["columns"], stated["rows"]
    if not isinstance(columns, Sequence) or isinstance(columns, str) or not isinstance(rows, Mapping):
        raise BadTable(what, "columns is a list, rows a mapping of lists", _SEE)
    entries = {}
    for row, cells in rows.items():
        if not isinstance(cells, Sequence) or isinstance(cells, str) or len(cells) != len(columns):
            raise BadTable(f"{what}: row {row}", f"needs {len(columns)} cells, one a column", 'leave empty ones as ""')
        for c, cell in enumerate(cells):
            found = _entries(cell, f"{what}: row {row}, column {c + 1}")
            if found:
                entries[str(row), c] = found
    sizes, serials = stated.get("sizes") or {}, stated.get("serials") or {}
    for key, table in (("sizes", sizes), ("serials", serials)):
        if not isinstance(table, Mapping) or not all(isinstance(v, Sequence) for v in table.values()):
            raise BadTable(f"{what}: {key}", "is not a mapping of lists", _SEE)
    named = {
        (str(r), i + 1): _serial(s or None, what) for r, v in serials.items() for i, s in enumerate(v) if r != "columns"
    }
    named |= {("", c): _serial(s or None, what) for c, s in enumerate(serials.get("columns", ()))}
    return Incidence(
        columns=tuple(str(c) for c in columns),
        rows=tuple(str(r) for r in rows),
        entries=entries,
        sizes={(str(r), i + 1): size for r, v in sizes.items() for i, size in enumerate(v)},
        serials={key: serial for key, serial in named.items() if serial},
    )


def _entries(cell: Any, what: str) -> tuple[Entry, ...]:
    """Entries of a cell: nothing, "1,2,0", "1,2,0 2,2,1", [1, 2, 0] or [[1, 2, 0], [2, 2, 1]]."""
    if cell is None or cell in ("", "-", "·", "0"):
        return ()
    if isinstance(cell, str):
        parts: list[Any] = [word.split(",") for word in cell.split()]
    elif isinstance(cell, Sequence) and cell and isinstance(cell[0], Sequence):
        parts = [word.split(",") if isinstance(word, str) else list(word) for word in cell]
    elif isinstance(cell, Sequence):
        parts = [list(cell)]
    else:
        parts = [[]]
    try:
        return tuple(Entry(*(int(number) for number in part)) for part in parts)
    except (TypeError, ValueError, OverflowError):
        raise BadTable(f"{what}: {cell!r}", "is not link,joint,turn", 'write "1,2,0"') from None
