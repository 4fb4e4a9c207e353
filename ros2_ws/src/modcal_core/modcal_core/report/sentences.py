"""One sentence for each effect, for a technician: what it is, how large, and under which condition that is known."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from modcal_core.effects.effect import ACROSS
from modcal_core.report.effect_sizes import Quantity

Sizes = Mapping[str, Quantity]
Teller = Callable[[str, str, str, Sizes], str]  # of place, direction and driver, as in reports, and sizes


def story(family: str, place: str, direction: str, driver: str, sizes: Sizes) -> str:
    """What an effect of this family at this place is."""
    return _TELLERS.get(family, _unknown)(place, direction, driver, sizes)


def _small(sizes: Sizes, name: str) -> str:
    value, _, unit = sizes[name]
    return f"{1e3 * value:.3g} m{unit}"


def _gear(place: str, direction: str, driver: str, sizes: Sizes) -> str:
    if "amplitude" in sizes:
        cycles = sizes["cycles_per_turn"][0]
        lines = sum(name.startswith("cycles_per_turn") for name in sizes)
        more = f", with {lines - 1} more such lines" if lines > 1 else ""
        return (
            f"{place}'s gear or encoder error repeats {cycles:.4g} times a turn with {_small(sizes, 'amplitude')}{more}"
        )
    size = f"{place} has an error of {_small(sizes, 'amplitude_rms')} RMS"
    if "cycles_per_turn" in sizes:
        return f"{size} that repeats about {sizes['cycles_per_turn'][0]:.3g} times a turn"
    return f"{size}, a curve over the joint's position"


def _compliance(place: str, direction: str, driver: str, sizes: Sizes) -> str:
    if "compliance_times_mass" in sizes:
        value, _, unit = sizes["compliance_times_mass"]
        if "at" in sizes:
            return f"{place} deflects under a load that came at one moment (stamp {sizes['at'][0]:.1f} s)"
        angle = "µrad" if "rad" in unit else "µm"
        per = "N m" if "rad" in unit else "N"
        return (
            f"{place} deflects under load by {1e6 * abs(value):.3g} {angle} per {per} that 1 kg at the tip exerts; the "
            "description states no masses, so no stiffness is known"
        )
    part = "bearing tilts" if direction == ACROSS else "joint deflects"
    value, _, unit = sizes.get("stiffness", (float("inf"), 0.0, "N m/rad"))
    carried = sizes.get("payload")
    more = f", and carries about {carried[0]:.2g} kg more than the description states" if carried else ""
    return f"{place}'s {part} under load, stiffness {value:.3g} {unit}{more}"


def _coupling(place: str, direction: str, driver: str, sizes: Sizes) -> str:
    value, _, unit = sizes["coupling"]
    return f"{place} moves with {driver.partition(':')[2]} by {1e6 * value:.0f} ppm ({value:.2e} {unit})"


def _over_time(place: str, direction: str, driver: str, sizes: Sizes) -> str:
    size = _components(sizes)
    if "at" in sizes:
        return f"{place} moved by {size} at one moment (stamp {sizes['at'][0]:.1f} s)"
    if "time_constant" in sizes:
        return f"{place} settles by {size} with a time constant of {sizes['time_constant'][0]:.0f} s"
    return f"{place} moves with {driver.replace(':', ' of ')} ({size})"


def _components(sizes: Sizes) -> str:
    """The directions of an effect put together: lengths, angles."""
    out = []
    for unit in ("m", "rad"):
        parts = [q for q in sizes.values() if q[2] == unit or q[2].startswith(f"{unit}/")]
        total = sum(value**2 for value, _, _ in parts) ** 0.5
        if total:
            out.append(f"{1e3 * total:.3g} m{parts[0][2]}")
    return " and ".join(out) or "nothing that was seen"


def _wobble(place: str, direction: str, driver: str, sizes: Sizes) -> str:
    return f"{place}'s axis tilts by {_components(sizes)} as it turns"


def _unknown(place: str, direction: str, driver: str, sizes: Sizes) -> str:
    size = _components(sizes)
    how = "" if size.startswith("nothing") else f" ({size})"
    return (
        f"{place} ({direction}) has an error of no known family that correlates with {driver.replace(':', ' of ')}{how}"
    )


_TELLERS: dict[str, Teller] = {
    "gear_harmonic": _gear,
    "gear_ratio": lambda place, _, __, s: f"{place} turns by {1e6 * s['ratio_error'][0]:.0f} ppm more than it reports",
    "compliance": _compliance,
    "payload": _compliance,
    "backlash": lambda place, _, driver, s: (
        f"{place} has {_small(s, 'backlash')} of backlash, taken up by {driver.replace(':', ' of ')}"
    ),
    "coupling": _coupling,
    "axis_wobble": _wobble,
    "thermal": _over_time,
    "drift": _over_time,
    "step": _over_time,
    "latency": lambda _, __, ___, s: f"readings are {1e3 * s['delay'][0]:.2f} ms late",
    "joint_lag": lambda place, _, __, s: f"{place} reports its position {1e3 * s['delay'][0]:.2f} ms late",
    "scale": lambda _, __, ___, s: f"the tracker's metre is off by {1e6 * s['scale'][0]:.0f} ppm",
    "outliers": lambda _, __, ___, s: f"{s['stations'][0]:.0f} stations are plainly wrong and were left out",
}
