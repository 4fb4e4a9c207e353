"""What a column's label says, by one table of rules: quantity, axis, joint and unit. Words only.

A label becomes a line of words. Each rule of :data:`RULES` has patterns for such lines: the group ``axis`` is the
column's own name, and what stands around it names the body. Columns of one body are put together in the order of the
rule. A new kind of column is a row of the table.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property


def words(text: str) -> frozenset[str]:
    """The words of a text."""
    return frozenset(text.split())


_BRACKETS = re.compile(r"[\[(<{]\s*([^\])>}]*)\s*[\])>}]")
_SUFFIX = re.compile(r"[_ ](k?Nm{1,2}|(?:rad|deg|mm|m)[/_]s|gon|kg|degC|hPa|bar|mm|m|in|cm|deg|rad|%)$", re.IGNORECASE)
_COVERAGE = re.compile(r"([23])[ _-]?(?:sigma|σ|std|s\b)|\bk ?= ?([23])|95")
_WORD = re.compile(r"[A-Za-z°µ]+|\d+")
_CAMEL = re.compile(r"(?<=[a-z])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])")
# Units as labels have them, and as a mapping does
_UNITS = "mm millimeter millimeters millimetre|cm|m meter meters metre|in inch inches|deg degree degrees °"
_UNITS += "|rad radian radians|gon|s sec seconds|ms|us µs|ns"
UNITS = {name: names.split()[0] for names in _UNITS.split("|") for name in names.split()}
MEASURED, COMMANDED, VELOCITY, EFFORT, OTHER = "measured", "commanded", "velocity", "effort", "other"
_ROLES = {
    OTHER: "current temp temperature temperatur error err std stddev sd sigma stdev sx sy sz deviation covariance "
    "payload mass residual acc acceleration qdd voltage status limit min max rms uncertainty quality intensity "
    "pressure druck humidity confidence frame index count",
    EFFORT: "effort torque tau moment trq load",
    VELOCITY: "velocity vel qd dq speed rate",
    COMMANDED: "commanded command cmd target desired des setpoint ref reference demand nominal soll planned goal",
}
_ROLE_WORDS = {role: words(said) for role, said in _ROLES.items()}
_COMPUTED = _ROLE_WORDS[COMMANDED] | {"tcp", "flange", "fk", "controller", "robot"}
_TURNS = "r rot rotation orientation euler q quat quaternion angle ori rpy rotvec attitude"
TURNS = words(_TURNS)
_TURN = rf"\b(?:{_TURNS.replace(' ', '|')})\b(?: \w+)*? "
_TRIPLES = "rx ry rz|roll pitch yaw|a b c|w p r|alpha beta gamma|phi theta psi|u v w|heading pitch roll|ax ay az"
_TRIPLES += "|ox oy oz|omega phi kappa|wx wy wz|rotx roty rotz|o a t"
_XYZ = (("x", "y", "z"),)
_ANGLE_ORDERS = tuple(tuple(triple.split()) for triple in _TRIPLES.split("|"))
_ANGLES = "|".join(sorted({name for order in _ANGLE_ORDERS for name in order}, key=len, reverse=True))
_PLAIN = words("rx ry rz roll pitch yaw rotx roty rotz")


@dataclass(frozen=True)
class Rule:
    """How columns of one kind are called. patterns: the first that fits a label's words counts. orders: names of the
    columns of a body, as they are read; none: each column is one by itself. words, barred: of which a label must have
    one, and none.
    """

    patterns: tuple[str, ...]
    orders: tuple[tuple[str, ...], ...] = ()
    words: frozenset[str] = frozenset()
    barred: frozenset[str] = frozenset()

    def axis(self, name: str) -> tuple[str, str] | None:
        """(name of the column in its body, name of the body) of a line of words; None where it is no such column."""
        words = frozenset(name.split())
        if (self.words and not self.words & words) or self.barred & words:
            return None
        for pattern in self.patterns:
            if (found := re.search(pattern, name)) is not None:
                group = found.lastgroup or 0
                rest = f"{name[: found.start(group)]} {name[found.end(group) :]}"
                return found[group].replace(" ", "") if group == "axis" else str(group), " ".join(rest.split())
        return None


def _matrix(base: int, columns: int) -> list[str]:
    return [f"{r}{c}" for r in range(base, base + 3) for c in range(base, base + columns)]


def _homogeneous(base: int) -> tuple[str, ...]:
    """Names of the place, then of the turn, in a matrix whose fourth column is the place."""
    place = [f"{r}{base + 3}" for r in range(base, base + 3)]
    return (*place, *(name for name in _matrix(base, 4) if name not in place))


_DIGITS = (r"(?P<axis>\d ?\d?)$",)
_SECOND = "elevation|el|elev|altitude|vertical|vert|zenith|zen|v|za|va"
RULES: Mapping[str, tuple[Rule, ...]] = {
    "position": (Rule((r"\b(?P<axis>[xyz])$", r"\b(?P<axis>[xyz])\b"), _XYZ, barred=TURNS | _ROLE_WORDS[OTHER]),
                 Rule((r"\b[tpd](?P<axis>[xyz])$",), _XYZ)),
    "difference": (Rule((r"\b(?P<axis>[xyz])\b",), _XYZ,
                        words("dif diff difference delta dev deviation err error d"), TURNS),
                   Rule((r"\bd(?P<axis>[xyz])$",), _XYZ)),
    "quaternion": (Rule((rf"(?:\bq ?|\be (?=\d)|{_TURN})(?P<axis>[xyzw]|\d)$",),
                        (tuple("xyzw"), tuple("xyz0"), tuple("0123"), tuple("1234"))),),
    "matrix": (Rule(_DIGITS, tuple(tuple(_matrix(b, 3)) for b in (1, 0))),
               Rule(_DIGITS, tuple(tuple(str(k) for k in range(b, b + 9)) for b in (1, 0)))),
    "homogeneous": (Rule(_DIGITS, (_homogeneous(1), _homogeneous(0))),),
    "angles": (Rule((rf"\b(?P<axis>{_ANGLES})$",), _ANGLE_ORDERS),
               Rule((rf"{_TURN}(?P<axis>[xyz])$",), _XYZ), Rule((r"\be (?P<axis>[123])$",), (tuple("123"),))),
    "bearing": (Rule((rf"\b(?:(?P<azimuth>azimuth|az|hz|horizontal|ha|azim|hza)|(?P<second>{_SECOND}))\b",),
                     (("azimuth", "second"),), barred=_ROLE_WORDS[OTHER]),),
    "range": (Rule((r"\b(?P<axis>distance|dist|range|rng|length|wire|slope|laenge|abstand)\b",
                    r"^(?P<axis>d)(?: \w+)?$"), barred=_ROLE_WORDS[OTHER] | {"x", "y", "z"}),),
    "touch": (Rule((r"\b(?P<axis>height|plane|dial|indicator|gap|clearance|gauge|standoff)\b",),
                   barred=_ROLE_WORDS[OTHER] | {"x", "y", "z"}),),
    "ray": (Rule((r"\b(?P<axis>ray|laser|beam|tof|lidar|sonar|ultrasonic)\b",),
                 barred=_ROLE_WORDS[OTHER] | words("x y z tracker")),),
    "deviation": (Rule((r"\b(?:s|sd|std|sigma|u)(?P<axis>[xyz])\b", r"\b(?P<axis>rx|ry|rz|roll|pitch|yaw|[xyz])\b",
                        r"(?P<axis>)$"), (*_XYZ, *_ANGLE_ORDERS[:2], ("",))),),
    "family": (Rule((r"(?P<axis>\d{1,4})(?=\D*$)",)),),
}  # fmt: skip


@dataclass(frozen=True)
class Label:
    """A label in parts. words: in small letters, numbers apart. unit: as a mapping names it, None: not told. told: the
    unit as the file has it, in small letters without blanks, "" where there is none.
    """

    text: str
    words: tuple[str, ...]
    unit: str | None
    told: str = ""

    @classmethod
    def of(cls, text: str, unit: str = "") -> Label:
        """A label, and what a row of units says below it."""
        told = [*_BRACKETS.findall(text), unit.strip("[]()<> ")]
        found = next((UNITS[t.strip().lower()] for t in told if t.strip().lower() in UNITS), None)
        inside = _BRACKETS.sub(lambda m: f" {m[1]} " if m[1].strip().isdigit() else " ", text)
        words = [w.lower() for part in _WORD.findall(inside) for w in _CAMEL.split(part)]
        if found is None and len(words) > 1 and words[-1] in UNITS:  # x_mm
            found = UNITS[words.pop()]
        raw = ["".join(t.lower().split()) for t in told]
        behind = _SUFFIX.search(text)
        name = next((t for t in raw if t and not any(c.isdigit() for c in t)), "")
        name = name or (behind[1].lower() if behind is not None else "")
        return cls(text, tuple(words), found, name.replace("·", "").replace("*", "").replace("_", "/"))

    @cached_property
    def name(self) -> str:
        """The words as one line, which rules are read on."""
        return " ".join(self.words)

    @property
    def role(self) -> str:
        """What a joint's column holds."""
        if self.coverage:
            return OTHER
        return next((role for role, said in _ROLE_WORDS.items() if said & set(self.words)), MEASURED)

    @property
    def coverage(self) -> str:
        """How many standard deviations it states, such as "2" of x (95 %); "" where it states none."""
        found = _COVERAGE.search(self.text.lower())
        return "" if found is None else found[1] or found[2] or "2"

    @property
    def computed(self) -> bool:
        """Whether it sounds like a pose that the controller computed, not one that was measured."""
        return bool(_COMPUTED & set(self.words))

    def axis(self, kind: str) -> tuple[str, str] | None:
        """(name of the column in its body, name of the body) as a column of a kind; None where it is none."""
        found = (rule.axis(self.name) for rule in RULES[kind])
        return None if self.coverage and kind != "deviation" else next((axis for axis in found if axis), None)

    @property
    def of_instrument(self) -> bool:
        """Whether it is one of a distance, a direction or a height."""
        return any(self.axis(kind) for kind in ("range", "bearing", "touch", "ray"))

    @property
    def plainly_turned(self) -> bool:
        """Whether it says plainly that the column is an angle of an orientation."""
        found = self.axis("angles")
        return found is not None and (found[0] in _PLAIN or bool(TURNS & set(found[1].split())))


def grouped(labels: Mapping[int, Label], kind: str) -> list[tuple[int, ...]]:
    """Columns whose labels make a body of a kind, each in the order of the rule."""
    out: list[tuple[int, ...]] = []
    lines = {k: label.name for k, label in labels.items() if kind == "deviation" or not label.coverage}
    for rule in RULES[kind]:
        axes = {k: axis for k, name in lines.items() if (axis := rule.axis(name)) is not None}
        out += _ordered(axes, rule.orders) if rule.orders else [(k,) for k in axes]
    return list(dict.fromkeys(out))


def families(labels: Mapping[int, Label], count: int) -> list[tuple[tuple[int, ...], str]]:
    """(columns, name) of labels that differ by a number alone, which counts from 1, or from 0, to so many."""
    (rule,) = RULES["family"]
    axes = {k: axis for k, label in labels.items() if (axis := rule.axis(label.text)) is not None}
    axes = {k: (str(int(number)), stem) for k, (number, stem) in axes.items()}
    orders = [tuple(str(k) for k in range(first, first + count)) for first in (1, 0)]
    found = {stem: _ordered({k: a for k, a in axes.items() if a[1] == stem}, orders)[:1] for _, stem in axes.values()}
    return [(columns, stem) for stem, some in found.items() for columns in some]


def _ordered(axes: Mapping[int, tuple[str, str]], orders: Iterable[Sequence[str]]) -> list[tuple[int, ...]]:
    """Columns of bodies that have all names of an order; of two with one name the first counts."""
    bodies: dict[str, dict[str, int]] = {}
    for k, (axis, body) in axes.items():
        bodies.setdefault(body, {}).setdefault(axis, k)
    return [tuple(found[n] for n in order) for order in orders for found in bodies.values() if set(order) <= set(found)]
