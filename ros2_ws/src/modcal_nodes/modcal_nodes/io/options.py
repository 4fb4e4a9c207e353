"""What is asked of a verb, as dataclasses: a field is an option of the command, with its type, default and help.

The command makes its parser from them; here is neither a parser nor any mathematics.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from modcal_msgs_py import Topics


def option(text: str = "", *names: str, default: Any = None, **more: Any) -> Any:
    """A field of a verb's options. text: its help. names: how it is given; none: as the field is called.

    The field's annotation says what it is: a Path exists, a bool is a flag, a tuple of texts may be repeated. more:
    bounds as ``low`` and ``high``, ``above`` in place of low where that is excluded; the rest as Click takes it.
    """
    return field(default=default, metadata={"names": names, "help": text or None, **more})


def repeated(text: str, metavar: str, *names: str) -> Any:
    """The same of texts, any number of them."""
    return option(text, *names, default=(), metavar=metavar)


@dataclass(frozen=True)
class ChainOptions:
    """Where an arm begins and ends."""

    base: str | None = option("Link where the arm begins. Default: the root link.", metavar="LINK")
    tip: str | None = option("Link where it ends. Default: the link behind most joints.", metavar="LINK")


@dataclass(frozen=True)
class TopicOptions:
    """What the topics of a bag are."""

    topic: tuple[str, ...] = repeated("The topic for a role, as tracker/pose=/vrpn/tool/pose. Repeatable.", "ROLE=NAME")
    ignore: tuple[str, ...] = repeated("Leave a topic out. Repeatable.", "TOPIC")
    tf: str | None = option("The tracker's readings are these frames in /tf, as tracker:tool.", metavar="PARENT:CHILD")

    @property
    def topics(self) -> Topics:
        """The same as readers of bags take it."""
        return Topics.of(self.topic, self.ignore, self.tf)


@dataclass(frozen=True)
class FrozenOptions(TopicOptions):
    """What is asked of a frozen calibration on a recording."""

    cell_file: Path | None = option(
        "YAML of known distances, fixed parameters, and statements on arm and instrument.", "--cell"
    )
    repeatability_mm: float | None = option("Repeatability of the arm, RMS over space.", above=0.0, metavar="MM")
    repeatability_iso: float | None = option("The same as RP of ISO 9283, of the data sheet.", above=0.0, metavar="MM")
    repeatability_deg: float | None = option("Repeatability of the orientation, RMS.", above=0.0, metavar="DEG")
    instrument_mm: float | None = option("Error of the instrument, RMS over space.", above=0.0, metavar="MM")
    instrument_deg: float | None = option("Orientation error of the instrument, RMS.", above=0.0, metavar="DEG")
    seed: int = option("Seed of the draw of stations that score.", default=0, low=0)
    clock_limit: float = option(
        "Largest offset between tracker and joint clocks that is corrected.", default=0.5, low=0.0, metavar="S"
    )
    tolerance_mm: float | None = option(
        "Allowed error: PASS, FAIL or CANNOT TELL; exit 3 unless PASS.", above=0.0, metavar="MM"
    )
    tolerance_of: str = option(
        "Which error of the held-out stations is compared with the tolerance.",
        default="p95",
        choices=("mean", "rms", "p95", "max"),
    )


@dataclass(frozen=True)
class SplitOptions(FrozenOptions):
    """The same where the stations are split."""

    block: int | None = option(
        "Stations that the split keeps together; 1 splits by station. Default: blocks for dense recordings.", low=1
    )


@dataclass(frozen=True)
class RobotOptions:
    """The robot, and what of it is fitted."""

    urdf: Path | None = option("Robot description. Default: the one in the bag.")
    delta: Path | None = option("Description of a Delta robot, instead of a URDF.")
    base: str | None = option("Link where the arm begins. Default: the root link.", metavar="LINK")
    tip: str | None = option("Link where it ends. Default: the link behind most recorded joints.", metavar="LINK")
    fixed: tuple[str, ...] = repeated("Keep a parameter or place nominal, e.g. tool. Repeatable.", "NAME", "--fix")
    geometry_only: bool = option("Fit only the geometry; do not look for other effects.", default=False)


@dataclass(frozen=True)
class Options(SplitOptions, RobotOptions):
    """What is asked of a calibration, beside the recording: the options of ``modcal calibrate`` under their names."""

    by_distances: bool = option("Of a Delta: compare fits and simulated annealing on distances alone.", default=False)
    factory_kinematics: Path | None = option(
        "What the manufacturer's tool took from this arm: kinematics.yaml keeps its form and hash.", metavar="FILE"
    )


class Watch(Protocol):
    """Hears what is being done, and, where that is known, the share of it that is done."""

    def __call__(self, stage: str, share: float | None = None) -> None:
        """Take notice."""


def silent(stage: str, share: float | None = None) -> None:
    """A watch that says nothing."""
