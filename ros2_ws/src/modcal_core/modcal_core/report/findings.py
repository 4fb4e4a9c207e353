"""What the diagnosis found, as entries of the report: one for each place and driver, with sizes and a sentence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from modcal_core.calibration.added import added_effects, added_shape
from modcal_core.calibration.chances import beyond_normal
from modcal_core.calibration.effects import ACROSS, ALL, AXIS, JOINTS, LENGTH, SHIFT, Effect
from modcal_core.calibration.identify import Fit
from modcal_core.calibration.model import Model
from modcal_core.calibration.noise import REJECT_Z
from modcal_core.calibration.parameters import DIRECTIONS
from modcal_core.calibration.posture_order import joints_instead
from modcal_core.calibration.regimes import is_move
from modcal_core.calibration.score import Errors, errors, outlying
from modcal_core.diagnosis.loop import Diagnosis
from modcal_core.diagnosis.vocabulary import WHOLE_CYCLES
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.samples import Samples

_UNDECIDED = 0.05  # of the usual load, below which its sign is not sure

Quantity = tuple[float, float, str]  # value, standard deviation, unit


@dataclass(frozen=True)
class Finding:
    """One entry. effects: what it consists of, fitted to all samples (a gear may have several lines). before, after:
    RMS error on held-out without it and with it [m], those found before it being there both times.
    """

    family: str
    place: str
    direction: str
    driver: str
    parameters: dict[str, Quantity]
    p_value: float
    before: float
    after: float
    same_as: tuple[str, ...] = ()
    effects: tuple[Effect, ...] = field(default=())

    @property
    def sentence(self) -> str:
        """What a technician should know of it."""
        gain = f"adding it takes the error from {1e3 * self.before:.3f} to {1e3 * self.after:.3f} mm"
        added = added_effects().get(self.family)
        story = f"{self.place} {added.story}" if added and added.story else _STORIES.get(self.family, _unknown)(self)
        return f"{story}; {gain}."


def findings(
    diagnosis: Diagnosis, shipped: Model, samples: Samples, wrong: np.ndarray, missed: Sequence[Errors]
) -> tuple[Finding, ...]:
    """Entries in the order found; the same place and driver found again joins its entry.

    shipped: the model fitted to all samples, its effects in the same order. wrong: samples far from the scored fit.
    missed: errors on held-out by geometry alone, then with each effect added.
    """
    entries: dict[tuple[object, ...], Finding] = {}
    before = _rms(missed[0])
    for cause, effect, left in zip(diagnosis.causes, shipped.effects, missed[1:], strict=True):
        after = _rms(left)
        # each move is an entry of its own
        key = (*effect.key, effect.shape.settings["at"]) if is_move(effect) else effect.key
        known = entries.get(key)
        effects = (*known.effects, effect) if known else (effect,)
        same = (*(known.same_as if known else ()), *_link_name(effect, shipped), *_posture(effect, samples))
        entries[key] = Finding(
            effect.family,
            effect.place,
            effect.direction,
            effect.public_driver,
            _parameters(effects),
            min(cause.p_value, known.p_value) if known else cause.p_value,
            known.before if known else before,
            after,
            tuple(dict.fromkeys((*same, *cause.same_as))),
            effects,
        )
        before = after
    wrong = wrong & outlying(shipped, diagnosis.fit.spread, samples) & _known(shipped, samples)
    return (*_outliers(diagnosis.fit, samples, wrong), *entries.values())


def _link_name(effect: Effect, model: Model) -> tuple[str, ...]:
    """What grows or creeps in front of a joint is the link there: its name, where the robot states it."""
    names, links = model.chain.names, model.chain.links
    if effect.direction == AXIS or effect.place not in names or not links:
        return ()
    return (f"{links[names.index(effect.place)]} {effect.direction} by {effect.public_driver}",)


def _posture(effect: Effect, samples: Samples) -> tuple[str, ...]:
    """Errors of joints that may be what a step is, where the order of the stations goes with the joint's position."""
    if effect.family != "step":
        return ()
    return joints_instead(samples, effect.shape.settings["at"])


def _known(model: Model, samples: Samples) -> np.ndarray:
    """False where it cannot be said on which side of its play a joint rests, (N,): unmoved so far, or hardly loaded."""
    known = np.ones(len(samples), bool)
    at = model.circumstances(samples)
    for effect in model.effects:
        if effect.family == "backlash":
            side = at.driver(effect.driver)
            known &= np.abs(side) > _UNDECIDED * np.sqrt(np.mean(side**2))
    return known


def _outliers(fit: Fit, samples: Samples, wrong: np.ndarray) -> tuple[Finding, ...]:
    if not wrong.any():
        return ()
    count = (float(len(np.unique(samples.station[wrong]))), 0.0, "1")
    with_them, without = (_rms(errors(fit.model, s)) for s in (samples, samples.select(np.flatnonzero(~wrong))))
    by_chance = min(1.0, len(samples) * beyond_normal(REJECT_Z))  # that noise makes any of them
    return (Finding("outliers", "tracker", ALL, "constant", {"stations": count}, by_chance, with_them, without),)


def _rms(missed: Errors) -> float:
    return float(np.sqrt(np.mean(missed.position_norm**2))) if len(missed.position) else float("nan")


def _parameters(effects: tuple[Effect, ...]) -> dict[str, Quantity]:
    """Named sizes of the effects of one entry; later ones are numbered."""
    out: dict[str, Quantity] = {}
    for i, effect in enumerate(effects):
        for name, quantity in _sizes(effect).items():
            out[name if i == 0 else f"{name}_{i + 1}"] = quantity
    return out


def _sizes(effect: Effect) -> dict[str, Quantity]:
    v, s, settings = effect.values, effect.std, effect.shape.settings
    unit = "m" if effect.direction in ("x", "y", "z", LENGTH, SHIFT) else "rad"
    if effect.direction == JOINTS:
        return {"delay": (float(v[0]), float(s[0]), "s")}
    if effect.family == "joint_lag":
        return {"delay": (-float(v[0]), float(s[0]), "s")}
    if effect.family == "scale":
        return {"scale": (float(v[0]), float(s[0]), "1")}
    if effect.shape.kind == "double":
        first, second = _wave(v[:2], s[:2], unit), _wave(v[2:4], s[2:4], unit)
        cycles = (settings["cycles"], float(s[4]), "1")
        return {
            **first,
            "cycles_per_turn": cycles,
            "amplitude_twice": second["amplitude"],
            "phase_twice": second["phase"],
        }
    if effect.shape.kind in ("sine", "turn") and effect.direction == AXIS:
        return {**_wave(v, s, unit), "cycles_per_turn": (settings["cycles"], float(s[2]) if len(s) > 2 else 0.0, "1")}
    if effect.shape.kind == "spline" and effect.direction == AXIS:
        return curve_sizes(effect)
    if effect.shape.kind == "since":
        return {"compliance_times_mass": (float(v[0]), float(s[0]), "kg rad/(N m)"), "at": (settings["at"], 0.0, "s")}
    if effect.family in ("compliance", "payload"):
        return _compliance(effect)
    if effect.family == "backlash":
        return {"backlash": (2.0 * abs(float(v[0])), 2.0 * float(s[0]), unit)}
    if effect.family in ("gear_ratio", "coupling"):
        return {"ratio_error" if effect.family == "gear_ratio" else "coupling": (float(v[0]), float(s[0]), "1")}
    out = _components(effect, unit)
    if effect.shape.kind in ("step", "until"):
        out["at"] = (settings["at"], 0.0, "s")
    if effect.shape.kind == "settle":
        out["time_constant"] = (settings["tau"], float(s[-1]), "s")
    if effect.shape.kind == "turn":
        out["cycles_per_turn"] = (settings["cycles"], 0.0, "1")
    if effect.lag:
        out["lag"] = (effect.lag, float(s[-1]), "s")
    if own := added_shape(effect.shape.kind):
        for name, std in zip(effect.refined, s[len(effect.amplitudes) :], strict=True):
            out[name] = (settings[name], float(std), own.refined[name].unit)
    return out


def _wave(v: Array, s: Array, unit: str) -> dict[str, Quantity]:
    size = float(np.hypot(v[0], v[1]))
    std = float(np.hypot(v[0] * s[0], v[1] * s[1]) / max(size, 1e-300))
    return {
        "amplitude": (size, std, unit),
        "phase": (float(np.arctan2(v[1], v[0])), std / max(size, 1e-300), "rad"),
    }


def _compliance(effect: Effect) -> dict[str, Quantity]:
    # an actuator's torque is the opposite of the load that it holds
    v, s = effect.values * (-1.0 if effect.driver.startswith("effort:") else 1.0), effect.std
    out = {"compliance": (float(v[0]), float(s[0]), "rad/(N m)")}
    if v[0]:
        out["stiffness"] = (1.0 / abs(float(v[0])), float(s[0] / v[0] ** 2), "N m/rad")
    if effect.shape.kind == "hardening":
        scale = effect.shape.settings["scale"]
        out = {
            "compliance": (float(v[0]) / scale, float(s[0]) / scale, "rad/(N m)"),
            "stiffness": (scale / abs(float(v[0])), float(s[0] * scale / v[0] ** 2), "N m/rad"),
            "hardening": (float(v[1] / v[0] ** 2), float(s[1] / v[0] ** 2), "1/rad^2"),
        }
    if effect.shape.kind == "several":
        ratio = float(v[1] / v[0])
        spread = abs(ratio) * float(np.hypot(s[0] / v[0], s[1] / v[1]))
        out["payload"] = (ratio, spread, "kg")
    return out


def _components(effect: Effect, unit: str) -> dict[str, Quantity]:
    """Amplitudes by direction; of several functions in one direction their root sum of squares."""
    per = "/s" if effect.shape.kind == "ramp" else "/K" if effect.driver.startswith("temperature") else ""
    names = component_names(effect)
    count = max(len(effect.amplitudes) // len(names), 1)
    out: dict[str, Quantity] = {}
    for i, name in enumerate(names):
        v = effect.amplitudes[i * count : (i + 1) * count]
        s = effect.std[i * count : (i + 1) * count]
        of = "m" if name in DIRECTIONS[:3] or unit == "m" else "rad"
        size = float(v[0]) if count == 1 else float(np.linalg.norm(v))
        out[name] = (size, float(np.linalg.norm(s)), of + per)
    return out


def component_names(effect: Effect) -> tuple[str, ...]:
    """The directions that an effect moves in by itself, each with amplitudes of its own."""
    return {ALL: DIRECTIONS, SHIFT: DIRECTIONS[:3], ACROSS: ("rx", "ry")}.get(effect.direction, (effect.direction,))


def curve(
    effects: tuple[Effect, ...], low: float, high: float, points: int, component: int = 0
) -> tuple[Array, Array, Array]:
    """What effects of one driver do together over a range of it: driver, size and its deviation, (points,) each.

    component: which of their directions, as in :func:`component_names`.
    """
    x = np.linspace(low, high, points)
    size, variance = np.zeros(points), np.zeros(points)
    for effect in effects:
        basis = effect.shape.basis(x)
        part = slice(component * len(basis), (component + 1) * len(basis))
        size += effect.amplitudes[part] @ basis
        variance += (effect.std[part] ** 2) @ basis**2
    return x, size, np.sqrt(variance)


def curve_sizes(effect: Effect) -> dict[str, Quantity]:
    """RMS of a free shape, and how often a turn it mostly repeats."""
    x, y, std = curve((effect,), effect.shape.settings["low"], effect.shape.settings["high"], 4096)
    y = y - y.mean()
    # slow parts are shared with the geometry; what repeats is looked for beyond them
    slow = np.stack([f(k * x) for k in range(WHOLE_CYCLES + 1) for f in (np.sin, np.cos)], axis=1)
    fast = y - slow @ np.linalg.lstsq(slow, y, rcond=1e-9)[0]
    power = np.abs(np.fft.rfft(fast * np.hanning(len(y)), 8 * len(y))) ** 2
    cycles = 2.0 * np.pi * np.fft.rfftfreq(8 * len(y), x[1] - x[0])
    top = float(cycles[int(np.argmax(power))])
    resolution = np.pi / float(x[-1] - x[0])
    return {
        "amplitude_rms": (float(np.sqrt(np.mean(y**2))), float(np.sqrt(np.mean(std**2))), "rad"),
        "cycles_per_turn": (top, resolution, "1"),
    }


def _mrad(f: Finding, name: str) -> str:
    value, _, unit = f.parameters[name]
    return f"{1e3 * value:.3g} {'mm' if unit == 'm' else 'mrad'}"


def _gear(f: Finding) -> str:
    cycles = f.parameters["cycles_per_turn"][0]
    if "amplitude" in f.parameters:
        lines = sum(name.startswith("cycles_per_turn") for name in f.parameters)
        more = f", with {lines - 1} more such rhythms" if lines > 1 else ""
        return f"{f.place}'s gear or encoder repeats {cycles:.4g} times a turn with {_mrad(f, 'amplitude')}{more}"
    return f"{f.place} errs by {_mrad(f, 'amplitude_rms')} RMS in a shape that repeats about {cycles:.3g} times a turn"


def _compliance_story(f: Finding) -> str:
    if "compliance_times_mass" in f.parameters:
        return f"{f.place} gives way to a load that came at one moment (stamp {f.parameters['at'][0]:.1f} s)"
    part = "bearing tilts" if f.direction == ACROSS else "joint gives way"
    stiffness = f.parameters.get("stiffness", (float("inf"), 0.0, ""))[0]
    carried = f.parameters.get("payload")
    more = f", about {carried[0]:.2g} kg more than the description knows" if carried else ""
    return f"{f.place}'s {part} under load, at {stiffness:.3g} N m/rad{more}"


def _coupling_story(f: Finding) -> str:
    return f"{f.place} moves by {1e6 * f.parameters['coupling'][0]:.0f} ppm of {f.driver.partition(':')[2]}"


def _step_story(f: Finding) -> str:
    shift, turn = (
        float(np.linalg.norm([f.parameters[d][0] for d in of if d in f.parameters]))
        for of in (DIRECTIONS[:3], DIRECTIONS[3:])
    )
    turned = f" and {np.degrees(turn):.2f}°" if any(d in f.parameters for d in DIRECTIONS[3:]) else ""
    moved = f"{f.place} moved" + (f" by {1e3 * shift:.2f} mm{turned}" if f.place in ("base", "tool") else "")
    when = f"at one moment (stamp {f.parameters['at'][0]:.1f} s)"
    joints = [name.partition(" by position:")[2] for name in f.same_as if " by position:" in name]
    if not joints:
        return f"{moved} {when}"
    return (
        f"either {moved} {when}, or {joints[0]} errs with its position: the stations before and after differ in it, "
        "and posture and time cannot be told apart"
    )


def _time_story(f: Finding) -> str:
    if f.family == "step":
        return _step_story(f)
    if "time_constant" in f.parameters:
        return f"{f.place} settles over time, by e every {f.parameters['time_constant'][0]:.0f} s"
    return f"{f.place} moves slowly with {f.driver.replace(':', ' of ')}"


def _unknown(f: Finding) -> str:
    where = f"{f.place} ({f.direction})"
    return f"{where} errs along with {f.driver.replace(':', ' of ')}, in a shape that has no name"


_STORIES = {
    "gear_harmonic": _gear,
    "gear_ratio": lambda f: f"{f.place} turns by {1e6 * f.parameters['ratio_error'][0]:.0f} ppm more than it reports",
    "compliance": _compliance_story,
    "payload": _compliance_story,
    "backlash": lambda f: f"{f.place} has {_mrad(f, 'backlash')} of play, taken up by {f.driver.replace(':', ' of ')}",
    "coupling": _coupling_story,
    "axis_wobble": lambda f: f"{f.place}'s axis tilts as it turns",
    "thermal": _time_story,
    "drift": _time_story,
    "step": _time_story,
    "latency": lambda f: f"readings come {1e3 * f.parameters['delay'][0]:.2f} ms late",
    "joint_lag": lambda f: f"{f.place} reports its position {1e3 * f.parameters['delay'][0]:.2f} ms late",
    "scale": lambda f: f"the tracker's metre is off by {1e6 * f.parameters['scale'][0]:.0f} ppm",
    "outliers": lambda f: f"{f.parameters['stations'][0]:.0f} stations are plainly wrong and were left out",
}
