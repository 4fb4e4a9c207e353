"""What a column's label says: of which quantity it is, along which axis, of which joint, in which unit. Words only."""

from __future__ import annotations

import re
from dataclasses import dataclass

_BRACKETS = re.compile(r"[\[(<{]\s*([^\])>}]*)\s*[\])>}]")
_SUFFIX = re.compile(r"[_ ](k?Nm{1,2}|(?:rad|deg|mm|m)[/_]s|gon|kg|degC|hPa|bar|mm|m|in|cm|deg|rad|%)$", re.IGNORECASE)
_COVERAGE = re.compile(r"([23])[ _-]?(?:sigma|σ|std|s\b)|\bk ?= ?([23])|95")
_WORD = re.compile(r"[A-Za-z°µ]+|\d+")
_CAMEL = re.compile(r"(?<=[a-z])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])")
# Units as labels have them, and as a mapping does
UNITS = {
    "mm": "mm", "millimeter": "mm", "millimeters": "mm", "cm": "cm", "m": "m", "meter": "m", "meters": "m",
    "in": "in", "inch": "in", "inches": "in", "deg": "deg", "degree": "deg", "degrees": "deg", "°": "deg",
    "rad": "rad", "radian": "rad", "radians": "rad", "s": "s", "sec": "s", "seconds": "s", "ms": "ms", "us": "us",
    "µs": "us", "ns": "ns",
}  # fmt: skip
MEASURED, COMMANDED, VELOCITY, EFFORT, OTHER = "measured", "commanded", "velocity", "effort", "other"
_ROLES = (
    (OTHER, {"current", "temp", "temperature", "error", "err", "std", "stddev", "sd", "sigma", "stdev", "sx", "sy",
             "sz", "deviation", "covariance", "payload", "mass", "residual", "acc",
             "acceleration", "qdd", "voltage", "status", "limit", "min", "max", "rms", "uncertainty", "quality",
             "intensity", "pressure", "humidity", "confidence", "frame", "index", "count"}),
    (EFFORT, {"effort", "torque", "tau", "moment", "trq", "load"}),
    (VELOCITY, {"velocity", "vel", "qd", "dq", "speed", "rate"}),
    (COMMANDED, {"commanded", "command", "cmd", "target", "desired", "des", "setpoint", "ref", "reference", "demand",
                 "nominal", "soll", "planned", "goal"}),
)  # fmt: skip
_COMPUTED = {"tcp", "flange", "fk", "controller", "robot", *dict(_ROLES)[COMMANDED]}
_DIFFERENCES = {"dif", "diff", "difference", "delta", "dev", "deviation", "err", "error", "d"}
TURNS = {
    "r",
    "rot",
    "rotation",
    "orientation",
    "euler",
    "q",
    "quat",
    "quaternion",
    "angle",
    "ori",
    "rpy",
    "rotvec",
    "attitude",
}
_ANGLE_TRIPLES = (
    ("rx", "ry", "rz"), ("roll", "pitch", "yaw"), ("a", "b", "c"), ("w", "p", "r"), ("alpha", "beta", "gamma"),
    ("phi", "theta", "psi"), ("e1", "e2", "e3"), ("u", "v", "w"), ("heading", "pitch", "roll"), ("ax", "ay", "az"),
    ("ox", "oy", "oz"), ("omega", "phi", "kappa"), ("wx", "wy", "wz"), ("rotx", "roty", "rotz"), ("o", "a", "t"),
)  # fmt: skip


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
        words = [w for part in _WORD.findall(inside) for w in _CAMEL.split(part)]
        words = [w.lower() for w in words]
        if found is None and len(words) > 1 and words[-1] in UNITS:  # x_mm
            found = UNITS[words[-1]]
            words = words[:-1]
        raw = ["".join(t.lower().split()) for t in told]
        behind = _SUFFIX.search(text)
        name = next((t for t in raw if t and not any(c.isdigit() for c in t)), "") or (
            behind[1].lower() if behind is not None else ""
        )
        return cls(text, tuple(words), found, name.replace("·", "").replace("*", "").replace("_", "/"))

    @property
    def role(self) -> str:
        """What a joint's column holds."""
        if self.coverage:
            return OTHER
        return next((role for role, said in _ROLES if said & set(self.words)), MEASURED)

    @property
    def coverage(self) -> str:
        """How many standard deviations it states, such as "2" of x (95 %); "" where it states none."""
        found = _COVERAGE.search(self.text.lower())
        return "" if found is None else found[1] or found[2] or "2"

    @property
    def computed(self) -> bool:
        """Whether it sounds like a pose that the controller computed, not one that was measured."""
        return bool(_COMPUTED & set(self.words))

    @property
    def axis(self) -> tuple[str, str] | None:
        """("x", rest of the label) of a coordinate of a position, None for others."""
        if not self.words:
            return None
        last, rest = self.words[-1], self.words[:-1]
        if last in ("x", "y", "z") and not TURNS & set(rest) and self.role != OTHER:
            return last, " ".join(rest)
        if len(last) == 2 and last[0] in "tpd" and last[1] in "xyz":  # Tx, px
            return last[1], " ".join((*rest, last[0]))
        for i, word in enumerate(self.words):  # X tool
            if word in ("x", "y", "z") and not TURNS & set(self.words) and self.role != OTHER:
                return word, " ".join(self.words[:i] + self.words[i + 1 :])
        return None

    @property
    def difference(self) -> tuple[str, str] | None:
        """("x", rest of the label) of a difference along an axis: ``x_dif``, ``Error Y [mm]``, ``dz``; or None."""
        rest = [w for w in self.words if w not in ("x", "y", "z")]
        axes = [w for w in self.words if w in ("x", "y", "z")]
        if len(axes) == 1 and _DIFFERENCES & set(rest) and not TURNS & set(rest):
            return axes[0], " ".join(rest)
        if self.words and self.words[-1] in ("dx", "dy", "dz"):
            return self.words[-1][1], " ".join((*self.words[:-1], "d"))
        return None


def angle_triples(labels: dict[int, Label]) -> list[tuple[int, int, int]]:
    """Columns whose labels are those of three angles, each three in the order of their names."""
    out = []
    flat = {i: _turn_word(label) for i, label in labels.items()}
    for names in _ANGLE_TRIPLES:
        by_stem: dict[str, dict[str, int]] = {}
        for i, (word, stem) in flat.items():
            if word in names:
                by_stem.setdefault(stem, {}).setdefault(word, i)
        out += [tuple(found[n] for n in names) for found in by_stem.values() if len(found) == 3]
    return list(dict.fromkeys((t[0], t[1], t[2]) for t in out))


_PLAIN_TURNS = {"rx", "ry", "rz", "roll", "pitch", "yaw", "rotx", "roty", "rotz"}


def turn_labels(labels: dict[int, Label]) -> set[int]:
    """Columns whose labels say plainly that they are angles of an orientation."""
    return {k for k, label in labels.items() if _turn_word(label)[0] in _PLAIN_TURNS}


def quaternions(labels: dict[int, Label]) -> list[tuple[int, int, int, int]]:
    """Columns whose labels are those of quaternions, in the order x y z w or as they are numbered."""
    out: list[tuple[int, int, int, int]] = []
    by_stem: dict[str, dict[str, int]] = {}
    for i, label in labels.items():
        words = label.words
        if not words:
            continue
        last, rest = words[-1], words[:-1]
        turned = bool(TURNS & set(rest))
        if last in ("qx", "qy", "qz", "qw"):
            by_stem.setdefault(" ".join(rest), {})[last[1]] = i
        elif turned and last in ("x", "y", "z", "w"):
            by_stem.setdefault(" ".join(rest), {})[last] = i
        elif last.isdigit() and rest and rest[-1] in ("q", "quat", "quaternion", "e"):
            by_stem.setdefault(label.text.rstrip("])}0123456789"), {})[last] = i
    for found in by_stem.values():
        if set(found) == {"0"}:  # Q0 Qx Qy Qz
            for other in by_stem.values():
                if set(other) == {"x", "y", "z"}:
                    other["w"] = found["0"]
    for found in by_stem.values():
        for names in (("x", "y", "z", "w"), ("0", "1", "2", "3"), ("1", "2", "3", "4")):
            if set(names) <= set(found):
                out.append((found[names[0]], found[names[1]], found[names[2]], found[names[3]]))
    return out


def matrices(labels: dict[int, Label]) -> list[tuple[int, ...]]:
    """Columns whose labels are those of the nine elements of a matrix, row by row or as they are numbered."""
    out = []
    for found in _elements(labels):
        for base in (1, 0):
            names = [f"{r}{c}" for r in range(base, base + 3) for c in range(base, base + 3)]
            numbered = [str(k) for k in range(base, base + 9)]
            out += [tuple(found[name] for name in wanted) for wanted in (names, numbered) if set(wanted) <= set(found)]
    return out


def homogeneous(labels: dict[int, Label]) -> list[tuple[tuple[int, int, int], tuple[int, ...]]]:
    """Columns whose labels are those of a matrix with the place as its fourth column: place, and nine elements."""
    out = []
    for found in _elements(labels):
        for base in (1, 0):
            rows = range(base, base + 3)
            turn, place = [f"{r}{c}" for r in rows for c in rows], [f"{r}{base + 3}" for r in rows]
            if {*turn, *place} <= set(found):
                x, y, z = (found[name] for name in place)
                out.append(((x, y, z), tuple(found[name] for name in turn)))
    return out


def _elements(labels: dict[int, Label]) -> list[dict[str, int]]:
    """Columns that are called the same but for numbers, by these."""
    cells: dict[str, dict[str, int]] = {}
    for i, label in labels.items():
        numbers = [w for w in label.words if w.isdigit()]
        rest = " ".join(w for w in label.words if not w.isdigit())
        if numbers and rest:
            cells.setdefault(rest, {})["".join(numbers)] = i
    return list(cells.values())


def _turn_word(label: Label) -> tuple[str, str]:
    """(word of an angle, rest of the label); ("", "") for others."""
    words = label.words
    if not words:
        return "", ""
    last, rest = words[-1], words[:-1]
    if last in ("x", "y", "z") and TURNS & set(rest):
        return f"r{last}", " ".join(w for w in rest if w not in TURNS)
    if last.isdigit() and rest and rest[-1] == "e":
        return f"e{last}", " ".join(rest[:-1])
    return last, " ".join(w for w in rest if w not in TURNS)
