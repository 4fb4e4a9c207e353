"""Assemblies as numbers, in the published code (Gao et al. 2014): what a search cuts, mixes and changes.

A base is [length, turn], 3 and 2 bits, the turn being that of the first joint on it. Every further sub-assembly is a
joint with its link, [joint, turn, link, length, turn], 1, 2, 2, 3 and 2 bits: ``00001 0·01·10·100·00 …``. The first
turn is that of the link on the joint, the second that of whatever comes next. As whole numbers, a base is one of 32 and
a sub-assembly, called a *gene* here, one of 1024; an arm of n joints is n + 1 of them. Kinds and lengths are the
library's: one with more than two kinds of joint has one more bit for them; a code that no module has makes a gene that
cannot be built.

In the assembly incidence matrix columns are the joints in order, then the gripper, whose number is 1; rows are the base
and the kinds of link. An entry (link number, joint number, turn) says that this link of its kind is bolted to that
joint, the one nearer the gripper turned by so many quarter turns about z. A link has two, in neighbouring columns.
Lengths stand beside the matrix, for each numbered link.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.errors import BadTable, refusing
from modcal_core.modules.library import JOINT, LINK, SIZES, TURNS, Assembly, Library, Module, ModuleType
from modcal_core.schema import TEXT, list_of, mapping_of, record, require, stated

BASES = SIZES * TURNS
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
        """How many codes each field of a gene has: joint, turn, link, length, next turn."""
        return len(self.joints), TURNS, len(self.links), SIZES, TURNS

    def fields(self, genes: ArrayLike) -> np.ndarray:
        """The five fields of genes (...), (5, ...)."""
        return np.stack(np.unravel_index(np.asarray(genes), self.shape))

    @cached_property
    def buildable(self) -> np.ndarray:
        """Whether the library has the joint, the link and its length, for every gene, (genes,)."""
        joint, _, link, size, _ = self.fields(np.arange(np.prod(self.shape)))
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


# --- The assembly incidence matrix, as plain data: columns, rows of cells, and lengths and serial numbers beside them

_Key = tuple[str, int]  # kind of a base or link, and its number among its kind


def matrix_of(assembly: Assembly, library: Library) -> dict[str, Any]:
    """The matrix of an assembly that has been checked; links are numbered by kind from the base on."""
    columns = [*assembly.joints, assembly.modules[-1]]
    rows = [assembly.modules[0].kind, *(t.name for t in library.of_role(LINK))]
    carriers = {row: [m for m in (assembly.modules[0], *assembly.links) if m.kind == row] for row in rows}
    out: dict[str, Any] = {
        "columns": [m.kind for m in columns],
        "rows": _cells(assembly, rows),
        "sizes": {row: [m.size for m in own] for row, own in carriers.items() if own},
    }
    if any(m.serial for m in assembly.modules):
        out["serials"] = {row: [m.serial for m in own] for row, own in carriers.items() if own}
        out["serials"]["columns"] = [m.serial for m in columns]
    return out


def matrix_text(matrix: Mapping[str, Any]) -> str:
    """The matrix for people, a row a line."""
    lines = [["", *matrix["columns"]], *([row, *(c or "·" for c in cells)] for row, cells in matrix["rows"].items())]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join("  ".join(x.ljust(w) for x, w in zip(line, widths, strict=True)).rstrip() for line in lines)


def _cells(assembly: Assembly, rows: Iterable[str]) -> dict[str, list[str]]:
    cells: dict[str, list[list[str]]] = {row: [[] for _ in range(assembly.n + 1)] for row in rows}
    count: dict[str, int] = {}
    for i, carrier in enumerate((assembly.modules[0], *assembly.links)):
        number = count[carrier.kind] = count.get(carrier.kind, 0) + 1
        for column in (i - 1, i) if i else (0,):
            turn = assembly.modules[i + column + 1].turn
            cells[carrier.kind][column].append(f"{number},{column + 1 if column < assembly.n else 1},{turn}")
    return {row: [" ".join(entries) for entries in own] for row, own in cells.items()}


def _assembly_of(matrix: Mapping[str, Any], library: Library, name: str, source: str) -> Assembly:
    """The assembly that a matrix describes: the way from the base over the links that lead to the next column. Written
    as a matrix again it must be the same. Raises BadTable, one line, at the first fault.
    """
    columns, rows = matrix["columns"], matrix["rows"]
    n = len(columns) - 1
    if n < 1 or not rows:
        raise BadTable(source, "has no joints", "give columns: joints in order, then the gripper")
    turns: dict[_Key, dict[int, int]] = {}  # of every link, by column
    for row, cells in rows.items():
        if len(cells) != n + 1:
            raise BadTable(f"{source}: row {row}", f"needs {n + 1} cells, one a column", 'leave empty ones as ""')
        for c, cell in enumerate(cells):
            for link, turn in _entries(cell, f"{source}: row {row}, column {c + 1}"):
                turns.setdefault((row, link), {})[c] = turn
    keys: list[_Key] = [(next(iter(rows)), 1)]
    for c in range(n):
        following = [key for key, touched in turns.items() if list(touched) == [c, c + 1]]
        if len(following) != 1:
            said = f"{len(following)} links lead from column {c + 1} to the next"
            raise BadTable(source, said, "give one link an entry in both, with the same number")
        keys += following
    for what in ("sizes", "serials"):
        for row, described in matrix.get(what, {}).items():
            if row != "columns" and len(described) > sum(kind == row for kind, _ in keys):
                offender = f"{source}: row {row} {len(described)}"
                raise BadTable(offender, "is described but not in the matrix", "leave it out")
    serials = matrix.get("serials", {})
    modules: list[Module] = []
    for i, (row, number) in enumerate(keys):
        own = turns.get((row, number), {})
        size, serial = (_nth(matrix.get(what, {}).get(row), max(number, 1) - 1) for what in ("sizes", "serials"))
        modules.append(Module(row, size or 0, own.get(i - 1, 0), _serial(serial)))
        modules.append(Module(columns[i], 0, own.get(i, 0), _serial(_nth(serials.get("columns"), i))))
    assembly = Assembly(tuple(modules), name).checked(library, source)
    for row, cells in _cells(assembly, rows).items():
        for c, (found, meant) in enumerate(zip(rows[row], cells, strict=True)):
            if sorted(_words(found)) != sorted(_words(meant)):
                said, is_ = " ".join(sorted(_words(found))) or "nothing", meant or "nothing"
                raise BadTable(f"{source}: row {row}, column {c + 1}", f"holds {said}, the arm {is_}", f"write {is_}")
    return assembly


def _words(cell: str | None) -> list[str]:
    return [] if cell in (None, "-", "·") else str(cell).split()


def _entries(cell: str | None, what: str) -> list[tuple[int, int]]:
    """Number of the link, and turn, of every entry in a cell."""
    try:
        return [(link, turn) for link, _, turn in (map(int, word.split(",")) for word in _words(cell))]
    except ValueError:
        raise BadTable(f"{what}: {cell!r}", "is not link,joint,turn", 'write "1,2,0"') from None


def _nth(values: Sequence[Any] | None, k: int) -> Any:
    return values[k] if values and k < len(values) else None


# --- An assembly from plain data, as its YAML file holds it (a list of modules, or an incidence matrix), and back

_FORMAT = 1
_SEE = "see docs/modules.md"
_TURNS = {0: 0, 1: 1, 2: 2, 3: 3, 90: 1, 180: 2, 270: 3}  # quarter turns, from degrees or from themselves
_SERIAL = {"type": ["string", "integer", "null"]}
_MODULE = record(("module",), module=TEXT, length={"type": "integer"}, turn={"enum": [*_TURNS]}, serial=_SERIAL)
_AIM = record(
    ("columns", "rows"),
    columns=list_of(TEXT),
    rows=mapping_of(list_of({"type": ["string", "null"]})),
    sizes=mapping_of(list_of({"type": "integer"})),
    serials=mapping_of(list_of(_SERIAL)),
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
    """The assembly that nested mappings and lists describe, checked against the library. Several of a list of modules,
    a matrix and a code must say the same. Raises BadTable.
    """
    top = stated(data)
    require(top, _SCHEMA, source, _SEE)
    name = plain_name(top.get("name", "modular_arm"), source)
    forms: dict[str, Assembly] = {}
    if "modules" in top:
        parts = (
            Module(m["module"], m.get("length", 0), _TURNS[m.get("turn", 0)], _serial(m.get("serial")))
            for m in top["modules"]
        )
        forms["modules"] = Assembly(tuple(parts), name).checked(library, source)
    if "aim" in top:
        forms["aim"] = _assembly_of(top["aim"], library, name, f"{source}: aim")
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
    coding = Coding(library)
    listed = [
        {"module": m.kind}
        | ({"length": m.size} if m.size else {})
        | ({"turn": 90 * m.turn} if i else {})
        | ({"serial": m.serial} if m.serial else {})
        for i, m in enumerate(assembly.modules)
    ]
    return {
        "modcal_assembly": _FORMAT,
        "name": assembly.name,
        "modules": listed,
        "aim": matrix_of(assembly, library),
        "code": coding.text(coding.genome(assembly)),
    }


def _serial(value: str | int | None) -> str:
    return "" if value is None else str(value).strip()


def plain_name(stated: Any, source: str) -> str:
    """A name that is one plain word. Raises BadTable."""
    name = str(stated)
    if not name or not all(c.isalnum() or c in "_-." for c in name):
        raise BadTable(f"{source}: name '{name}'", "is not a plain word", "use letters, digits, _ and -")
    return name
