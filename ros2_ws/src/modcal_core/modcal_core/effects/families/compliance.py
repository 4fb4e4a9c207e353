"""A joint that deflects under its load, a bearing that tilts under the moment across its axis, or a yielding base.

The deflection is the load times a compliance [rad/(N m), m/N], or that of a spring that gets stiffer. Loads are those
of gravity and, where the actuators report them, their torques; without masses a compliance is known per kilogram only.
A recorded number may say how much is carried (``/payload_kg``): then the load at the tip is it times that of 1 kg.
What the arm stands on (a table, a column, a cart) may turn and shift in any direction with the moment about either of
its horizontal axes. In motion a joint winds up as it is accelerated, and a target that is held softly stays behind; a
damper delays both: of the acceleration a while ago the jerk tells.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from modcal_core.effects.drivers import Drivers
from modcal_core.effects.effect import ACROSS, ALL, AXIS, Effect
from modcal_core.effects.family import Family, ReportEntry, complexity_of_joint, in_words
from modcal_core.effects.registry import KILOGRAMS as KILOGRAMS
from modcal_core.effects.registry import carried_signals, in_motion, loads, moving_joints, varies
from modcal_core.effects.shapes import Shape
from modcal_core.effects.sizes import Sizes, unit_of, value
from modcal_core.robots import Mechanism, is_serial_arm

NAME, BASE = "compliance", "base"
_NO_SPRING = (
    "no spring does that: a controller that compensates too much does, or weight that pulls another way, or loads or "
    "readings of the opposite sign"
)
HARDENINGS = (0.3, 1.0, 3.0, 10.0)  # share of the cubic term at the usual load


def candidates(drivers: Drivers) -> Iterator[Effect]:
    """Every joint whose load varies, as a linear spring and as ones that get stiffer; every bearing, linear."""
    for j, name in enumerate(drivers.arm.chain.names):
        for driver, load in loads(drivers, j).items():
            yield Effect(NAME, name, AXIS, driver, Shape("linear"))
            scale = float(np.sqrt(np.mean(load**2)))
            for beta in HARDENINGS:
                yield Effect(NAME, name, AXIS, driver, Shape("hardening", {"scale": scale, "beta": beta}))
        for signal in carried_signals(drivers):
            tip = drivers.values(f"payload:{name}")
            if varies(tip * drivers.values(signal)):
                if drivers.arm.weighed:
                    yield Effect(NAME, name, AXIS, f"load:{name},payload:{name},{signal}", Shape("carried"))
                yield Effect(NAME, name, AXIS, f"payload:{name},{signal}", Shape("product"))
                beside = ",".join(f"offset_{axis}:{name}" for axis in "xyz")
                yield Effect(NAME, name, AXIS, f"{beside},{signal}", Shape("products"))
        if drivers.arm.weighed:  # a sliding joint's column is bent by the moment as a bearing is
            yield Effect(NAME, name, ACROSS, f"moment:{name}", Shape("linear"))
    if drivers.samples.moving.any() and in_motion(drivers):
        for _, name in moving_joints(drivers):
            yield Effect(NAME, name, AXIS, f"acceleration:{name},jerk:{name}", Shape("several"))
        for axis in "xyz" if is_serial_arm(drivers.arm.chain) else "":
            yield Effect(NAME, "tool", axis, f"tip_acceleration_{axis},tip_jerk_{axis}", Shape("several"))
    on_base = f"{'weight' if drivers.arm.weighed else 'tip_weight'}:{drivers.arm.chain.names[0]}"
    if is_serial_arm(drivers.arm.chain) and any(map(varies, drivers.values(on_base))):
        yield Effect(NAME, BASE, ALL, on_base, Shape("several"))


def of_joint(joint: str, compliance: float) -> Effect:
    """A linear spring [rad/(N m), m/N] about one joint's axis, loaded by gravity."""
    return Effect(NAME, joint, AXIS, f"load:{joint}", Shape("linear")).started(np.array([compliance]))


def carrying(effects: Sequence[Effect]) -> tuple[Effect, ...]:
    """The effects, with one compliance for own weight and stated payload at each joint that deflects under the latter.

    What a joint would have of the payload's centre for itself is left out.
    """
    out, done = [], {e.place for e in effects if e.shape.kind == "carried"}
    for effect in effects:
        if effect.shape.kind == "product" and effect.driver.startswith("payload:") and effect.place not in done:
            done.add(effect.place)
            whole = Effect(NAME, effect.place, AXIS, f"load:{effect.place},{effect.driver}", Shape("carried"))
            out.append(whole.started(effect.amplitudes))
        elif effect.shape.kind not in ("product", "products"):
            out.append(effect)
    return tuple(out)


def sizes(effect: Effect, chain: Mechanism) -> Sizes:
    """Compliance and, where masses are known, stiffness; how much a spring hardens. Of a base the largest turn by a
    moment.
    """
    if effect.place == BASE:
        turn, std = effect.values[6:].reshape(3, 2), float(effect.std[6:].max())
        unit, name = ("kg rad/(N m)", "_times_mass") if effect.driver.startswith("tip") else ("rad/(N m)", "")
        return {f"compliance{name}": (float(np.linalg.norm(turn, 2)), std, unit)}
    unit = unit_of(effect, chain)
    if "acceleration" in effect.driver:
        size, std, per = value(effect, 0, -1.0, f"{unit}/({unit}/s^2)")
        gain = max(abs(size), 1e-12)
        return {"wind_up": (size, std, per), "delay": value(effect, 1, 1.0 / gain if size > 0.0 else -1.0 / gain, "s")}
    load = "N m" if unit == "rad" else "N"
    # an actuator's torque is the opposite of the load that it holds
    sign = -1.0 if effect.driver.startswith("effort:") else 1.0
    hardens = effect.shape.kind == "hardening"
    scale = effect.shape.settings["scale"] if hardens else 1.0
    v, s, _ = value(effect)
    v, s = sign * v / scale, s / scale
    if effect.shape.kind == "products":
        per = "" if effect.driver.endswith(KILOGRAMS) else "kg "
        return {f"compliance_times_offset_{a}": value(effect, i, 1.0, f"{per}{unit}/N") for i, a in enumerate("xyz")}
    if effect.shape.kind == "product":
        signal = effect.driver.rpartition(",")[2]
        in_kg = signal.endswith(KILOGRAMS)
        if not in_kg:  # whatever one of it weighs is part of the number
            return {"compliance_per_unit": (v, s, f"kg {unit}/({load})")}
    if effect.driver.startswith("payload:") and effect.shape.kind != "product":  # a stiffness needs a mass
        out: Sizes = {"compliance_times_mass": (v, s, f"kg {unit}/({load})")}
    else:
        out = {"compliance": (v, s, f"{unit}/({load})")}
        if v > 0.0:  # what moves against its load is no spring
            out["stiffness"] = (1.0 / abs(v), s / v**2, f"{load}/{unit}")
    if hardens:
        first, beta, std = sign * float(effect.values[0]), sign * float(effect.values[1]), float(effect.std[1])
        out["hardening"] = (beta / first**2, std / first**2, f"1/{unit}^2")
    return out


def sentence(entry: ReportEntry) -> str:
    """Stiffness, or compliance per newton that one kilogram exerts; and what no spring does."""
    if "compliance_times_offset_x" in entry.sizes:
        return f"{entry.place} deflects under a recorded payload whose centre lies beside the tip"
    if "wind_up" in entry.sizes:
        size, std, unit = entry.sizes["wind_up"]
        per = "µrad per rad/s²" if "rad" in unit else "µm per m/s²"
        amount = in_words((1e6 * abs(size), 1e6 * std, per))
        if size > 0.0:
            return f"{entry.place} stays behind as it is accelerated, by {amount}"
        return f"{entry.place} runs ahead as it is accelerated, by {amount}; no spring does that: a controller may"
    name = next(name for name in ("compliance_per_unit", "compliance_times_mass", "compliance") if name in entry.sizes)
    size, std, unit = entry.sizes[name]
    angle, per = ("µrad", "N m") if "rad" in unit else ("µm", "N")
    amount = f"{in_words((1e6 * abs(size), 1e6 * std, angle))} per {per}"
    what = f"{entry.place}'s bearing or column tilts" if entry.direction == ACROSS else f"{entry.place} deflects"
    if entry.place == BASE:
        what = "what the arm stands on turns"
    way = "under" if size > 0.0 else "against"
    if name == "compliance_per_unit":
        said = f"{what} {way} a load at the tip that a recorded number tells, by {amount} that 1 kg exerts there, for "
        said += "each unit of it"
    elif name == "compliance_times_mass":
        said = f"{what} {way} load by {amount} that 1 kg at the tip exerts"
        said += "; the description states no masses, so no stiffness is known"
    elif size > 0.0 and entry.place != BASE:
        return f"{what} under load, stiffness {in_words(entry.sizes['stiffness'])}"
    else:
        said = f"{what} {way} load by {amount}"
    return said if size > 0.0 else f"{said}; {_NO_SPRING}"


FAMILY = Family(NAME, candidates, complexity=complexity_of_joint, sizes=sizes, sentence=sentence)
