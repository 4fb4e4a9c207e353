"""The tables of a session: what a technician is asked for, in degrees and millimetres, and what came back.

What a spreadsheet does to a file on the way (semicolons, decimal commas, byte order marks, UTF-16) is undone; what may
have been typed wrongly is refused with its row, and nothing of that table is taken in. Base and tool are those on which
most stations agree: a nominal arm is a centimetre off at most; another unit, row or digit are off by more.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from modcal_core.errors import BadTable, refusing
from modcal_core.geometry import Array, so3
from modcal_core.hypotheses import LIMIT_OF_REACH, HandEye, HandEyeFit, left_handed, placed
from modcal_core.measurements import POSE
from modcal_core.planning.session import MEASURED, PLANNED, SKIPPED, UNSEEN, Session, Station
from modcal_core.robots import Mechanism, is_serial_arm

_POINT_COLUMNS, _POSE_COLUMNS = ("x_mm", "y_mm", "z_mm"), ("rx_deg", "ry_deg", "rz_deg")
NOTE = "note"  # the column in which a technician says what became of a station
_UNSEEN_WORDS, _SKIPPED_WORDS, _LATER_WORDS = ("unseen", "not seen"), ("skipped", "not reached"), ("", "later")
CHECKED = "checked"  # of a reading that is as it is, however unlikely
_OFF = 0.02  # rad or m by which the arm may stand beside the posture that was asked for; more is a mistake of typing
_SAME = 2e-8  # m, rad; twice the last digit that tables are written with
_WORKBOOKS = (b"PK\x03\x04", b"\xd0\xcf\x11\xe0")  # the first bytes of .xlsx and .ods, and of .xls


@dataclass(frozen=True)
class FilledTable:
    """session: with what the table says. read: numbers of the stations whose readings are new. checked: those of them
    that somebody has looked at again.
    """

    session: Session
    read: tuple[int, ...] = ()
    checked: tuple[int, ...] = ()


def to_table(session: Session, numbers: Sequence[int], revolute: np.ndarray) -> str:
    """A CSV table of these stations: number, what it is for, joints, reading and a note, each empty where not known."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["station", "for", *_joint_columns(session.names, revolute), *_reading_columns(session.kind), NOTE])
    for i in numbers:
        s = session.stations[i]
        q = s.asked if s.q is None else s.q
        shown = [f"{v:.5f}" for v in np.where(revolute, np.degrees(q), 1e3 * q)]
        note = s.state if s.state in (UNSEEN, SKIPPED) else ""
        read = [""] * len(_reading_columns(session.kind))
        if s.reading is not None:
            turned = np.degrees(so3.to_rpy(so3.from_quaternion(s.reading[3:]))) if session.kind == POSE else ()
            read = [f"{v:.5f}" for v in (*(1e3 * s.reading[:3]), *turned)]
        writer.writerow([i + 1, s.role, *shown, *read, note])
    return out.getvalue()


def _joint_columns(names: Sequence[str], revolute: np.ndarray) -> list[str]:
    return [f"{name}_{'deg' if turns else 'mm'}" for name, turns in zip(names, revolute, strict=True)]


def _reading_columns(kind: str) -> tuple[str, ...]:
    return (*_POINT_COLUMNS, *_POSE_COLUMNS) if kind == POSE else _POINT_COLUMNS


def text_of(data: bytes, source: str) -> str:
    """The text of a table as spreadsheets write it. Raises BadTable for a workbook."""
    if data.startswith(_WORKBOOKS):
        raise BadTable(source, "is a workbook, not a table of text", "save it as CSV, under the same name")
    encoding = "utf-16" if data.startswith((b"\xff\xfe", b"\xfe\xff")) else "utf-8-sig"
    return data.decode(encoding, errors="replace")


@refusing
def with_table(session: Session, text: str, revolute: np.ndarray, source: str) -> FilledTable:
    """The session with what a technician wrote into a table of its pending stations.

    A row whose reading is empty and that says nothing in its note is left for later; one that was taken in before is
    passed over. Raises BadTable with the row for what cannot be: a station that is not asked for or stands twice, half
    a reading, joints far from where they were asked to be, a note that says something else.
    """
    first_line = text.partition("\n")[0]  # spreadsheets write semicolons where the comma is a decimal point
    separator = max((",", "\t"), key=first_line.count)
    separator = ";" if first_line.count(";") > first_line.count(",") else separator
    lines = list(csv.reader(io.StringIO(text.lstrip("\ufeff")), delimiter=separator))
    head = [cell.strip() for cell in lines[0]] if lines else []
    for name in ("station", *_joint_columns(session.names, revolute), *_reading_columns(session.kind)):
        if head.count(name) != 1:
            raise BadTable(source, f"has {head.count(name)} columns '{name}'", "keep the head of the table as it was")
    first: dict[int, int] = {}
    filled = FilledTable(session)
    for row, line in enumerate(lines[1:], 2):
        cells = {name: (line[k].strip() if k < len(line) else "") for k, name in enumerate(head)}
        at = f"{source}, row {row}"
        if not any(cells.values()):
            continue
        if any(cell.strip() for cell in line[len(head) :]):
            said = f"has {len(line)} cells, the head has {len(head)}"
            raise BadTable(at, said, "separate columns by semicolons where the comma is a decimal point")
        number = int(_number(cells["station"], f"{at}, station")) - 1
        if number in first:
            raise BadTable(at, f"station {number + 1} stands in row {first[number]} as well", "keep one of them")
        first[number] = row
        filled = _filled(filled, number, cells, revolute, at)
    return filled


def _filled(filled: FilledTable, number: int, cells: Mapping[str, str], turns: np.ndarray, at: str) -> FilledTable:
    """With one row of the table. turns: joints that do, (n,). at: where the row stands."""
    session = filled.session
    if not 0 <= number < len(session.stations):
        raise BadTable(at, f"station {number + 1} is not asked for", "keep the numbers of the table as they were")
    joints, read = _joint_columns(session.names, turns), _reading_columns(session.kind)
    station, note = session.stations[number], cells.get(NOTE, "").lower()
    written = any(cells[name] for name in read)
    if note in _UNSEEN_WORDS or note in _SKIPPED_WORDS:
        state = UNSEEN if note in _UNSEEN_WORDS else SKIPPED
        if written:
            raise BadTable(at, f"has a reading and says '{note}'", "delete one of them")
        if station.state not in (PLANNED, state):
            raise _taken_before(at, number, station)
        return replace(filled, session=session.with_station(number, replace(station, state=state)))
    if not written:
        if note not in _LATER_WORDS:
            raise BadTable(at, f"has no reading and says '{note}'", "write unseen, skipped or later, or the reading")
        return filled
    values, stood = (np.array([_number(cells[n], f"{at}, {n}") for n in names]) for names in (read, joints))
    q = np.where(turns, np.radians(stood), 1e-3 * stood)
    reading = 1e-3 * values[:3]
    if session.kind == POSE:
        reading = np.r_[reading, so3.to_quaternion(so3.from_rpy(np.radians(values[3:])))]
    if station.reading is not None and np.abs(station.reading - reading).max() < _SAME:
        return filled
    if station.state != PLANNED:
        raise _taken_before(at, number, station)
    off = np.abs(q - station.asked)
    if off.max() > _OFF:
        k = int(np.argmax(off))
        size = f"{np.degrees(off[k]):.2f}°" if turns[k] else f"{1e3 * off[k]:.1f} mm"
        raise BadTable(f"{at}, {joints[k]}", f"is {size} from where it was asked to be", "correct it, or note: skipped")
    checked = (*filled.checked, number) if note == CHECKED else filled.checked
    return FilledTable(session.with_station(number, station.measured(reading, q)), (*filled.read, number), checked)


def _taken_before(at: str, number: int, station: Station) -> BadTable:
    was = "with another reading" if station.state == MEASURED else f"as {station.state}"
    said = f"station {number + 1} was taken in before, {was}"
    return BadTable(at, said, "open the table again, which has the stations asked for now")


def _number(cell: str, where: str) -> float:
    try:
        value = float(cell.replace(",", "."))
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        remedy = "write one, without separators of thousands, or leave the whole reading empty"
        raise BadTable(where, f"'{cell}' is not a number", remedy)
    return value


_MIN = 10  # stations; of fewer, base and tool leave nothing to tell a wrong one by
_MAX = 2.0 / 3.0  # of the stations that agree; where fewer do it is the arm that is off, or all readings are wrong
_UNITS = ((1e3, "metres"), (10.0, "centimetres"), (25.4, "inches"), (1e-3, "micrometres"))  # with their size in mm
_CLEARLY = 2.0  # times what a nominal arm misses by
_BETTER = 4.0  # times smaller must be what is missed, before all readings are said to be mistaken


def require_likely(session: Session, mechanism: Mechanism, read: Sequence[int], source: str) -> None:
    """Raises BadTable for the first of the stations read just now whose reading cannot be one of this arm, with what it
    may be. Nothing is asked of a Delta, nor of few stations.
    """
    rows = session.rows()
    if not is_serial_arm(mechanism) or len(rows) < _MIN or not read:
        return
    fit = placed(HandEye.holding(session.samples(rows), mechanism))
    agree = fit.agree()
    if agree.mean() < _MAX:
        _require_convention(fit, source)
        return
    expected, limit = fit.placement.expected(fit.case.A)[1], _CLEARLY * fit.case.limits[1]
    elsewhere = f"from where the other {int(agree.sum())} readings have it"
    for k in np.flatnonzero(~fit.agree(_CLEARLY) & np.isin(rows, read)).tolist():
        what, remedy = _meant(fit.case.p[k], expected, k, rows, limit, elsewhere)
        if not what:
            what = f"is turned by {np.degrees(float(fit.turn[k])):.1f}° {elsewhere}"
        raise BadTable(f"{source}, station {rows[k] + 1}", what, f"{remedy}; if it is right, note: {CHECKED}")


def _require_convention(as_is: HandEyeFit, source: str) -> None:
    case, mirrored = as_is.case, left_handed()  # by which axis nothing says: a tracker stands in any way
    meant = [(f"readings {said}", case.read(other), remedy) for said, other, remedy in _of_units(case.p)]
    meant.append((mirrored.what, mirrored.undone(case), mirrored.remedy))
    left, i = min((placed(other, thorough=False).usual[1], i) for i, (_, other, _) in enumerate(meant))
    if left < min(LIMIT_OF_REACH * case.chain.reach(), as_is.usual[1] / _BETTER):
        said = f"{meant[i][0]}: the arm misses them by {1e3 * as_is.usual[1]:.0f} mm, corrected by {1e3 * left:.0f} mm"
        raise BadTable(source, said, meant[i][2])


def _meant(p: Array, expected: Array, k: int, numbers: Sequence[int], limit: float, elsewhere: str) -> tuple[str, str]:
    """What the reading p (3,) [m] of row k may have been meant to be, "" where it is at its place, and what to do, by
    what the other readings let expect (N, 3) of the stations with these numbers (N,).
    """
    gap, far = p - expected[k], np.linalg.norm(expected - p, axis=1)
    if far[k] < limit:
        return "", "correct rx, ry and rz (degrees, about fixed axes)"
    for said, other, remedy in _of_units(p):
        if float(np.linalg.norm(other - expected[k])) < limit:
            return said, remedy
    nearest, axis = int(np.argmin(far)), int(np.argmax(np.abs(gap)))
    if far[nearest] < limit:
        said = f"has what the arm should read at station {numbers[nearest] + 1}"
        return said, "write each reading into its own row"
    if float(np.linalg.norm(np.delete(gap, axis))) < limit:
        said = f"{'xyz'[axis]} is {1e3 * gap[axis]:+.1f} mm {elsewhere}; the rest fits"
        return said, "look for a wrong digit or decimal point"
    return f"lies {1e3 * far[k]:.0f} mm {elsewhere}", "correct it, or note: unseen"


def _of_units(p: Array) -> Iterator[tuple[str, Array, str]]:
    """What positions [m] would be in another unit: words for it, the positions, and what to do."""
    for scale, unit in _UNITS:
        yield f"look{'s' * (p.ndim == 1)} like {unit}", scale * p, "write millimetres"
