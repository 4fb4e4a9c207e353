"""Refusals of what was imported from tables: the remedy lies in the mapping, for nobody can record it again."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from modcal_core.errors import BadRecording
from modcal_core.measurements.recording import IMPORTED

# What is said of a bag that was recorded, and what to do where it was imported
_IN_THE_MAPPING = {
    "record radians": "correct the unit of joints",
    "record metres": "correct the unit of lengths",
    "correct the names in joint_states": "correct the columns of joints",
    "check that the URDF, --base and --tip are those of this robot, and that joint and tracker clocks agree": (
        "check that the URDF, --base and --tip are those of this robot, and correct columns and units"
    ),
}


def imported_by(notes: Sequence[str]) -> str | None:
    """Name of the mapping by which a recording with these notes was imported; None where it was recorded."""
    return next((note.removeprefix(IMPORTED).rstrip(".") for note in notes if note.startswith(IMPORTED)), None)


@contextmanager
def remedies_of(notes: Sequence[str]) -> Iterator[None]:
    """Refusals from within say what to do about a recording with these notes."""
    try:
        yield
    except BadRecording as error:
        mapping = imported_by(notes)
        if mapping is None or error.remedy not in _IN_THE_MAPPING:
            raise
        remedy = f"{_IN_THE_MAPPING[error.remedy]} in {mapping}, and import again"
        raise BadRecording(error.offender, error.limit, remedy) from error
