"""A case, and the rows that cases are made of: a name, what is true, words, and steps that make the recordings."""

from __future__ import annotations

import copy
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import wraps
from inspect import isfunction
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from sites import Array, Cell, Session


@dataclass(frozen=True)
class Case:
    """What is recorded, what is done with it, and what is true.

    sessions: by the name of their bag. steps: arguments of modcal, ``{name}`` being a path in the case's folder and
    ``{out0}`` the first result; the last report is judged. fault: whether something is wrong. must_name: patterns
    (regular expressions, case ignored) of which the grounds have to hold one; empty where any word that it is open will
    do. shown: whether its data show the fault; if not, it is enough not to be calm; ``"if left"``: where more than 1.5
    times the floor is left; ``"if missed"``: the same, and nothing was planted, so that with less left it may be open
    for whatever else the arm has. files: others, by name. floor_mm: of what is judged, where that is no session. aside:
    further steps; the last, on an untouched recording, says what is truly left of a calibration. must_not: patterns
    that no cause may hold. planted: families of effects that the arm truly has besides.
    """

    sessions: dict[str, Session]
    steps: tuple[tuple[str, ...], ...]
    fault: bool
    must_name: tuple[str, ...] = ()
    shown: bool | str = True
    files: dict[str, str] = field(default_factory=dict)
    floor_mm: float | None = None
    aside: tuple[tuple[str, ...], ...] = ()
    must_not: tuple[str, ...] = ()
    planted: tuple[str, ...] = ()

    @property
    def best_mm(self) -> float:
        """What the best model leaves of the recording that is judged, RMS [mm]."""
        return self.judged.floor_mm if self.floor_mm is None else self.floor_mm

    @property
    def judged(self) -> Session:
        """The recording that the last step is about."""
        return [self.sessions[a[1:-1]] for a in self.steps[-1] if a[1:-1] in self.sessions][-1]

    def write(self, folder: Path) -> None:
        """Every bag and file of it below a folder."""
        for name, session in self.sessions.items():
            session.write(folder / name)
        for name, text in self.files.items():
            (folder / name).write_text(text, encoding="utf-8")


DERIVED: dict[str, Callable[[Any], Any]] = {
    "n": lambda c: len(c.names),  # joints
    "N": lambda c: len(c.q),  # stations
    "rows": lambda c: np.arange(c.N),  # their numbers (N,)
    "name": lambda c: c.names[c.i],  # of the joint that was drawn
    "x": lambda c: c.q[:, c.i],  # its column (N,)
}


class Scene:
    """What the steps of a row work on: a cell, what was drawn so far, and the recording as it is by now.

    An attribute is what ``let`` has named, or is found by a function in DERIVED, or is one of the recording (while a
    fault bends the truth of the stations: q, t, came, and d, the deviation), or of the cell. i: the joint of ``pick``.
    """

    def __init__(self, w: Cell, rng: np.random.Generator) -> None:
        self.w, self.rng, self.session = w, rng, None
        self.bends, self.used, self.parts, self.sessions = [], [], [], {}
        self.imports, self.command, self.options, self.planted = (), ("calibrate", "{bag}"), (), ()
        self.truth: dict[str, Any] = {}

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        if name in DERIVED:
            return DERIVED[name](self)
        return getattr(self.session if hasattr(self.session, name) else self.w, name)

    def at(self, stations: Any, deviation: Any = None) -> Scene:
        """The same scene while the truth at stations is bent."""
        seen = copy.copy(self)
        seen.session = SimpleNamespace(q=stations.q, t=stations.t, came=stations.came, d=deviation)
        return seen

    def visited(self) -> tuple[Array, Array]:
        """The postures that were drawn, and which are second visits; no longer after that."""
        return self.__dict__.pop("q"), self.__dict__.pop("again")

    def of(self, value: Any) -> Any:
        """A value that may depend on the scene: of what is called, and of what is named."""
        return getattr(self, value) if isinstance(value, str) else value(self) if callable(value) else value

    def vector(self, size: Any) -> Array:
        """A vector (3,): of this length into a random direction; zero, without a draw, of the integer 0."""
        if isinstance(size, int) and size == 0:
            return np.zeros(3)
        return self.way(size) if isinstance(size, float) else np.asarray(self.of(size))


Step = Callable[[Scene], Any]


def step(function: Callable[..., Any]) -> Callable[..., Any]:
    """Lets a function of a scene and of values be called without the scene: that gives a function of it, a step."""

    @wraps(function)
    def either(*values: Any, **named: Any) -> Any:
        if values and isinstance(values[0], Scene):
            return function(*values, **named)
        return lambda c: function(c, *values, **named)

    return either


def export(names: dict[str, Any], more: dict[str, Callable[..., Any]]) -> None:
    """Makes steps of the functions among names whose first value is a scene c, and of more."""
    made = {n: f for n, f in names.items() if isfunction(f) and f.__code__.co_varnames[:1] == ("c",)} | more
    names.update({name: step(function) for name, function in made.items()})


def words_of(scene: Scene, words: Any) -> tuple[str, ...]:
    """Words, those that depend on what was drawn among them, in one tuple."""
    if isinstance(words, str):
        return (words,)
    if callable(words):
        return words_of(scene, words(scene))
    return tuple(word for part in words for word in words_of(scene, part))


def not_true(words: tuple[str, ...], names: tuple[str, ...], fault: bool) -> tuple[str, ...]:
    """Patterns that no cause may hold beside a true word: of joints that no word means; of a good arm any."""
    if not fault:
        return (".",)
    meant = {name for name in names for word in words if re.search(word, name, re.I)}
    return tuple(rf"\b{re.escape(name)}\b" for name in names if name not in meant) if words else ()


@dataclass
class Row:
    """One kind. says: what is true. words: of which the grounds hold one. no: that no cause may hold. truth: fields of
    the case. steps: numbers are recordings of so many stations, others change the scene, one after the other."""

    says: str
    words: tuple[Any, ...]
    no: Any
    fault: bool
    truth: dict[str, Any]
    steps: tuple[int | Step, ...] = ()

    def __call__(self, w: Any, rng: np.random.Generator) -> Case:
        """The case; draws are made in the order of the steps."""
        scene = Scene(w, rng)
        for step in self.steps:
            take(scene, step) if isinstance(step, int) else step(scene)
        words = words_of(scene, self.words)
        no = not_true(words, scene.names, self.fault) if self.no is None else words_of(scene, self.no)
        sessions, session = scene.sessions, scene.session
        if session is not None:
            sessions = {**sessions, "second" if sessions else "bag": session}
        told: dict[str, Any] = {"must_not": no, "planted": scene.planted}
        told |= {name: v(scene) if callable(v) else v for name, v in scene.truth.items()} | self.truth
        steps = (*scene.imports, (*scene.command, *scene.options))
        return Case(sessions, steps, self.fault, words, **told)


def take(scene: Scene, count: int, **options: Any) -> None:
    """A recording of random postures, six of them twice, with the faults that wait."""
    scene.used, scene.bends = scene.bends, []
    scene.session = scene.clean(count, *scene.used, **options)


KINDS: dict[str, dict[str, Row]] = {}


def kinds(group: str, fault: bool = True) -> tuple[Callable[..., Callable[..., None]], Callable[..., None]]:
    """What writes the rows of a group: a head, and the steps below it, a line or more.

    ``K(name, says, *words, no=..., **truth)`` and below it ``S(*steps)``; in one line ``K(...)(*steps)``. Strings and
    tuples among the steps are more words.
    """
    rows = KINDS.setdefault(group, {})

    def steps(*more: Any) -> None:
        row = rows[next(reversed(rows))]
        row.words += tuple(one for one in more if isinstance(one, str | tuple))
        row.steps += tuple(one for one in more if not isinstance(one, str | tuple))

    def head(name: str, says: str, *words: Any, no: Any = None, **truth: Any) -> Callable[..., None]:
        assert all(name not in others for others in KINDS.values()), name
        rows[name] = Row(says, words, no, fault, truth)
        return steps

    return head, steps
