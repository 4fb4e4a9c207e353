"""A joint that deflects under a mass at the tip that the description does not know.

Either it carried the mass all along, and its amplitudes are the compliance to the known load and to 1 kg at the tip; or
the mass came at one time, and only their product is known.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from modcal_core.effects.drivers import Drivers
from modcal_core.effects.effect import AXIS, Effect
from modcal_core.effects.families import compliance
from modcal_core.effects.family import Family, ReportEntry
from modcal_core.effects.registry import breaks, loads, varies
from modcal_core.effects.shapes import Shape
from modcal_core.effects.sizes import Sizes, settings_of, value
from modcal_core.geometry import Array
from modcal_core.robots import Mechanism

NAME = "payload"
BREAKS_NEARBY = 12  # times between stations that are tried, where it is known about when the mass came
_MAX_KG = 100.0  # above what all but the largest arms carry; a larger one is another effect that imitates a mass
_SURE = 5.0  # standard deviations from which a mass is accepted


def candidates(drivers: Drivers) -> Iterator[Effect]:
    """Every joint that a mass at the tip would load, where no actuator reports what it truly carries."""
    for j, name in enumerate(drivers.arm.chain.names):
        weight = drivers.payload[j, 5]
        if drivers.arm.weighed and varies(weight) and f"effort:{name}" not in loads(drivers, j):
            yield Effect(NAME, name, AXIS, f"load:{name},payload:{name}", Shape("several"))


def since(drivers: Drivers, time: float) -> Iterator[Effect]:
    """Joints that deflect under a mass that was put into the hand about this time [s]."""
    between = breaks(drivers)
    for j, name in enumerate(drivers.arm.chain.names):
        if varies(drivers.payload[j, 5 if drivers.arm.chain.revolute[j] else 2]):
            for k in np.argsort(np.abs(between - time))[:BREAKS_NEARBY]:
                shape = Shape("since", {"at": float(between[k])})
                yield Effect(NAME, name, AXIS, f"payload:{name},time", shape)


def is_weight(amplitudes: Array) -> bool:
    """Whether the compliances to load and payload stand for a mass that an arm can carry."""
    return 0.0 < float(amplitudes[1] / amplitudes[0]) < _MAX_KG if amplitudes[0] else False


def plausible(effect: Effect) -> bool:
    """Whether the mass is one that an arm can carry."""
    return effect.shape.kind != "several" or is_weight(effect.amplitudes)


def plainer(effect: Effect) -> Effect | None:
    """The joint's compliance alone, where the mass is not sure or none that an arm could carry."""
    if effect.shape.kind != "several":
        return None
    if abs(effect.values[1]) >= _SURE * effect.std[1] and is_weight(effect.values):
        return None
    return compliance.of_joint(effect.place, float(effect.values[0]))


def sizes(effect: Effect, chain: Mechanism) -> Sizes:
    """Compliance, stiffness and mass; of a mass that came at one time, the product and when."""
    if effect.shape.kind == "since":
        return {"compliance_times_mass": value(effect, 0, 1.0, "kg rad/(N m)"), **settings_of(effect)}
    out = compliance.sizes(effect, chain)
    if effect.shape.kind == "several":
        v, s = effect.values, effect.std
        ratio = float(v[1] / v[0])
        out["payload"] = (ratio, abs(ratio) * float(np.hypot(s[0] / v[0], s[1] / v[1])), "kg")
    return out


def sentence(entry: ReportEntry) -> str:
    """When a load came, or what is carried beyond the description."""
    if masses := [size for name, size in entry.sizes.items() if name.startswith("mass")]:
        said = ", ".join(f"{kg:.2f} kg" for kg, _, _ in masses)
        return f"{entry.place} carries {said} more than the description states"
    if "at" in entry.sizes:
        return f"{entry.place} deflects under a load that was added at one moment (stamp {entry.sizes['at'][0]:.1f} s)"
    carried = entry.sizes.get("payload")
    more = f", and carries about {carried[0]:.2g} kg more than the description states" if carried else ""
    return compliance.sentence(entry) + more


FAMILY = Family(NAME, candidates, plausible=plausible, plainer=plainer, sizes=sizes, sentence=sentence)
