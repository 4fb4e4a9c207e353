"""An assembly from plain data, as its YAML file holds it (a list of modules, or an incidence matrix), and back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from modcal_core.errors import BadTable, refusing
from modcal_core.modules.coding import Entry, Incidence, assembly_of, incidence_of
from modcal_core.modules.library import Assembly, Library, Module

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
