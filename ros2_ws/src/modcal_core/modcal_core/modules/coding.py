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
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.errors import BadTable, refusing
from modcal_core.modules.library import JOINT, LINK, SIZES, TURNS, Assembly, Library, Module, ModuleType
from modcal_core.schema import TEXT, list_of, record, require, stated

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


_Key = tuple[str, int]  # kind of the row, and number among its kind
_Cells = dict[tuple[str, int], tuple[Entry, ...]]


def incidence_of(assembly: Assembly, library: Library) -> Incidence:
    """The matrix of an assembly that has been checked; links are numbered by kind from the base on."""
    carriers, touched = (assembly.modules[0], *assembly.links), (*assembly.joints, assembly.modules[-1])
    count: dict[str, int] = {}
    keys: list[_Key] = []
    for carrier in carriers:
        count[carrier.kind] = count.get(carrier.kind, 0) + 1
        keys.append((carrier.kind, count[carrier.kind]))
    serials = {key: m.serial for key, m in zip(keys, carriers, strict=True) if m.serial}
    serials |= {("", c): m.serial for c, m in enumerate(touched) if m.serial}
    return Incidence(
        columns=tuple(m.kind for m in touched),
        rows=(assembly.modules[0].kind, *(t.name for t in library.of_role(LINK))),
        entries=_cells(assembly, keys),
        sizes={key: m.size for key, m in zip(keys, carriers, strict=True)},
        serials=serials,
    )


def _cells(assembly: Assembly, keys: Sequence[_Key]) -> _Cells:
    """The entries by (row, column) of an assembly whose base and links have these numbers."""
    out: _Cells = {}
    turns = [m.turn for m in assembly.modules[1:]]
    for i, (row, number) in enumerate(keys):
        for column, turn in ((i - 1, turns[2 * i - 1]), (i, turns[2 * i])) if i else ((0, turns[0]),):
            entry = Entry(number, column + 1 if column < assembly.n else 1, turn)
            out[row, column] = (*out.get((row, column), ()), entry)
    return out


def assembly_of(matrix: Incidence, library: Library, name: str = "modular_arm", source: str = "aim") -> Assembly:
    """The assembly that a matrix describes: the way from the base over the links that lead to the next column. Written
    as a matrix again it must be the same. Raises BadTable, one line, at the first fault.
    """
    n = len(matrix.columns) - 1
    if n < 1 or not matrix.rows:
        raise BadTable(source, "has no joints", "give columns: joints in order, then the gripper")
    columns: dict[_Key, list[int]] = {}
    turns: dict[tuple[_Key, int], int] = {}
    for (row, column), entries in sorted(matrix.entries.items(), key=lambda item: item[0][1]):
        for entry in entries:
            columns.setdefault((row, entry.link), []).append(column)
            turns[(row, entry.link), column] = entry.turn
    keys: list[_Key] = [(matrix.rows[0], 1)]
    for c in range(n):
        following = [key for key, touched in columns.items() if touched == [c, c + 1]]
        if len(following) != 1:
            said = f"{len(following)} links lead from column {c + 1} to the next"
            raise BadTable(source, said, "give one link an entry in both, with the same number")
        keys += following
    for row in matrix.rows:
        numbers = sorted(number for kind, number in keys if kind == row)
        if numbers != list(range(1, len(numbers) + 1)):
            said = f"has numbers {', '.join(map(str, numbers))}"
            raise BadTable(f"{source}: row {row}", said, f"number them 1 to {len(numbers)}")
    modules: list[Module] = []
    for i, key in enumerate(keys):
        turn = turns.get((key, i - 1), 0) if i else 0
        modules.append(Module(key[0], matrix.sizes.get(key, 0), turn, matrix.serials.get(key, "")))
        modules.append(Module(matrix.columns[i], 0, turns.get((key, i), 0), matrix.serials.get(("", i), "")))
    assembly = Assembly(tuple(modules), name).checked(library, source)
    written = _cells(assembly, keys)
    for row, column in sorted({*matrix.entries, *written}):
        found, meant = (set(map(str, cells.get((row, column), ()))) for cells in (matrix.entries, written))
        if found != meant:
            said, is_ = " ".join(sorted(found)) or "nothing", " ".join(sorted(meant)) or "nothing"
            raise BadTable(f"{source}: row {row}, column {column + 1}", f"holds {said}, the arm {is_}", f"write {is_}")
    for key in (*matrix.sizes, *matrix.serials):
        if key[0] and key not in keys:
            raise BadTable(f"{source}: {key[0]} {key[1]}", "is described but not in the matrix", "leave it out")
    return assembly


# --- An assembly from plain data, as its YAML file holds it (a list of modules, or an incidence matrix), and back

_FORMAT = 1
_SEE = "see docs/modules.md"
_TURNS = {0: 0, 1: 1, 2: 2, 3: 3, 90: 1, 180: 2, 270: 3}  # quarter turns, from degrees or from themselves
_SERIAL = {"type": ["string", "integer", "null"]}
_MODULE = record(("module",), module=TEXT, length={"type": "integer"}, turn={"enum": [*_TURNS]}, serial=_SERIAL)
_AIM = record(
    ("columns", "rows"),
    columns=list_of(TEXT),
    rows={"type": "object", "additionalProperties": list_of({})},
    sizes={"type": "object", "additionalProperties": list_of({"type": "integer"})},
    serials={"type": "object", "additionalProperties": list_of(_SERIAL)},
)
_SCHEMA = record(
    ("modcal_assembly",),
    modcal_assembly={"enum": [_FORMAT]},
    name=TEXT,
    library=TEXT,
    modules=list_of(_MODULE),
    aim=_AIM,
    code=TEXT,
)


@refusing
def assembly_from_data(data: Any, library: Library, source: str) -> Assembly:
    """The assembly that nested mappings and lists describe, checked against the library. Raises BadTable.

    Where several of a list of modules, a matrix and a code are given, they must say the same.
    """
    top = stated(data)
    require(top, _SCHEMA, source, _SEE)
    name = plain_name(top.get("name", "modular_arm"), source)
    forms: dict[str, Assembly] = {}
    if "modules" in top:
        parts = [
            Module(m["module"], m.get("length", 0), _TURNS[m.get("turn", 0)], _serial(m.get("serial")))
            for m in top["modules"]
        ]
        forms["modules"] = Assembly(tuple(parts), name).checked(library, source)
    if "aim" in top:
        forms["aim"] = assembly_of(_incidence(top["aim"], f"{source}: aim"), library, name, f"{source}: aim")
    if "code" in top:
        coding = Coding(library)
        forms["code"] = coding.assembly(coding.parse(top["code"]), name)
    if not forms:
        raise BadTable(source, "names no modules", "give modules:, aim: or code:")
    (first, made), *others = forms.items()
    for form, other in others:
        pairs = list(zip(made.modules, other.modules, strict=False))
        if form == "code":  # says nothing of serial numbers
            pairs = [(replace(a, serial=b.serial), b) for a, b in pairs]
        differ = next((i for i, (a, b) in enumerate(pairs) if a != b), len(pairs))
        if differ < max(len(made.modules), len(other.modules)):
            raise BadTable(source, f"{first} and {form} differ from module {differ + 1} on", "leave one of them out")
    return made


def assembly_to_data(assembly: Assembly, library: Library) -> dict[str, Any]:
    """The assembly as a list of modules, as its matrix and as its code; reading it gives the same assembly."""
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
        "modcal_assembly": _FORMAT,
        "name": assembly.name,
        "modules": [_module_to_data(m, i > 0) for i, m in enumerate(assembly.modules)],
        "aim": aim,
        "code": Coding(library).text(Coding(library).genome(assembly)),
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


def _serial(value: str | int | None) -> str:
    return "" if value is None else str(value).strip()


def plain_name(stated: Any, source: str) -> str:
    """A name that is one plain word. Raises BadTable."""
    name = str(stated)
    if not name or not all(c.isalnum() or c in "_-." for c in name):
        raise BadTable(f"{source}: name '{name}'", "is not a plain word", "use letters, digits, _ and -")
    return name


def _incidence(data: Mapping[str, Any], what: str) -> Incidence:
    columns = data["columns"]
    entries: _Cells = {}
    for row, cells in data["rows"].items():
        if len(cells) != len(columns):
            raise BadTable(f"{what}: row {row}", f"needs {len(columns)} cells, one a column", 'leave empty ones as ""')
        found = (_entries(cell, f"{what}: row {row}, column {c + 1}") for c, cell in enumerate(cells))
        entries |= {(row, c): held for c, held in enumerate(found) if held}
    sizes, serials = data.get("sizes", {}), dict(data.get("serials", {}))
    of_columns = {("", c): _serial(s) for c, s in enumerate(serials.pop("columns", ()))}
    named = {(row, i + 1): _serial(s) for row, values in serials.items() for i, s in enumerate(values)}
    return Incidence(
        columns=tuple(columns),
        rows=tuple(data["rows"]),
        entries=entries,
        sizes={(row, i + 1): size for row, values in sizes.items() for i, size in enumerate(values)},
        serials={key: serial for key, serial in (named | of_columns).items() if serial},
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
