"""A case: recordings, what modcal is asked to do with them, and what is true."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from workcell import Session, Works


@dataclass(frozen=True)
class Case:
    """What is recorded, what is done with it, and what is true.

    sessions: by the name of their bag. steps: arguments of modcal, ``{name}`` being a path in the case's folder and
    ``{out0}`` the first result; the last report is judged. fault: whether something is wrong. must_name: patterns
    (regular expressions, case ignored) of which the grounds have to hold one; empty where any word that it is open will
    do. floor: whether the recording that is judged tells its floor. shown: whether its data show the fault; if not, it
    is enough not to be calm; ``"if left"``: where more than 1.5 times the floor is left; ``"if missed"``: the same, and
    nothing was planted, so that with less left it may be open for whatever else the arm has. files: others, by name.
    tables: sessions that are no bags but files, to be imported. floor_mm: of what is judged, where that is no session.
    aside: further steps; the last, on an untouched recording, says what is truly left of a calibration.
    """

    sessions: dict[str, Session]
    steps: tuple[tuple[str, ...], ...]
    fault: bool
    must_name: tuple[str, ...] = ()
    floor: bool = True
    shown: bool | str = True
    files: dict[str, str] = field(default_factory=dict)
    tables: tuple[str, ...] = ()
    floor_mm: float | None = None
    aside: tuple[tuple[str, ...], ...] = ()

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
            if name not in self.tables:
                session.write(folder / name)
        for name, text in self.files.items():
            (folder / name).write_text(text, encoding="utf-8")


Maker = Callable[[Works, np.random.Generator], Case]
KINDS: dict[str, dict[str, Maker]] = {
    name: {}
    for name in (
        *(
            "main",
            "later",
            "fresh",
            "fresh_again",
            "fresh_third",
            "fresh_fourth",
            "nearby",
            "fresh_fifth",
            "fresh_sixth",
            "fresh_seventh",
            "fresh_eighth",
        ),
        *("real", "ninth"),
        *("good", "good_fifth", "good_eighth"),
    )
}


def kind(group: str = "main") -> Callable[[Maker], Maker]:
    """Registers a maker under its own name in a group."""

    def register(maker: Maker) -> Maker:
        name = maker.__name__.strip("_")
        assert all(name not in group for group in KINDS.values()), name
        KINDS[group][name] = maker
        return maker

    return register


def calibrated(session: Session, must_name: tuple[str, ...] = (), *options: str, **truth: Any) -> Case:
    """One recording with a fault, calibrated."""
    told = {"floor": bool(session.again.any()), **truth}
    return Case({"bag": session}, (("calibrate", "{bag}", *options),), True, must_name, **told)


def frozen(first: Session, second: Session, must_name: tuple[str, ...] = (), *options: str, **truth: Any) -> Case:
    """A calibration on the first recording, evaluated on the second, which has the fault."""
    steps = (("calibrate", "{first}"), ("evaluate", "{out0}", "{second}", *options))
    told = {"floor": bool(second.again.any()), **truth}
    return Case({"first": first, "second": second}, steps, True, must_name, **told)
