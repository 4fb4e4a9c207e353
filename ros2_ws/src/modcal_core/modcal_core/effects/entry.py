"""An entry of a report, and the words that families make their sentences of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from modcal_core.effects.sizes import Quantity

_ROUGH = 0.1  # of a size: with a standard deviation beyond, it is given with its spread
_DETERMINED = 3.0  # standard deviations from zero: below, the recording does not tell a size from none


@dataclass(frozen=True)
class ReportEntry:
    """What a report has of one effect, or of several of one family, place and driver, with names as in reports.

    sizes: by name. same_as: what explains it as well, by name.
    """

    place: str
    direction: str
    driver: str
    sizes: Mapping[str, Quantity]
    same_as: tuple[str, ...] = ()

    @property
    def of_driver(self) -> str:
        """The driver in words: ``load of elbow_joint``."""
        return self.driver.replace(":", " of ")

    def thousandths(self, name: str) -> str:
        """A size in millimetres, or whatever its unit is thousand times smaller, with its spread where it is rough."""
        value, std, unit = self.sizes[name]
        return in_words((1e3 * value, 1e3 * std, f"m{unit}"))

    def determined(self, name: str) -> bool:
        """Whether the size is three of its standard deviations from zero, so that it may be stated."""
        value, std, _ = self.sizes[name]
        return abs(value) > _DETERMINED * std

    @property
    def total(self) -> str:
        """The directions put together: lengths, angles."""
        out = []
        for unit in ("m", "rad"):
            parts = [q for q in self.sizes.values() if q[2] == unit or q[2].startswith(f"{unit}/")]
            total = sum(value**2 for value, _, _ in parts) ** 0.5
            if total:
                out.append(f"{1e3 * total:.3g} m{parts[0][2]}")
        return " and ".join(out) or "nothing that was recorded"


def in_words(quantity: Quantity) -> str:
    """A size with its unit, and ± one standard deviation where that is more than a tenth of it."""
    value, std, unit = quantity
    spread = f" ± {std:.2g}" if std > _ROUGH * abs(value) else ""
    return f"{value:.3g}{spread} {unit}"


def unnamed(entry: ReportEntry) -> str:
    """What can be said where no family has a better sentence."""
    size = entry.total
    how = "" if size.startswith("nothing") else f" ({size})"
    return (
        f"{entry.place} ({entry.direction}) has an error of no known family that correlates with {entry.of_driver}{how}"
    )


def over_time(entry: ReportEntry) -> str:
    """What moved at one time, settles, or follows a driver slowly."""
    if "at" in entry.sizes:
        return f"{entry.place} moved by {entry.total} at one moment (stamp {entry.sizes['at'][0]:.1f} s)"
    if "time_constant" in entry.sizes:
        tau = entry.sizes["time_constant"][0]
        return f"{entry.place} settles by {entry.total} with a time constant of {tau:.0f} s"
    return f"{entry.place} moves with {entry.of_driver} ({entry.total})"
