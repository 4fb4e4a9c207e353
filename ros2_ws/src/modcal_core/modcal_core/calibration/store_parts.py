"""The parts of a calibration as plain data and back: models, instruments, effects, and the covariance.

What reads raises KeyError, TypeError, ValueError, IndexError or BadRobot for what is damaged; the store adds the file's
name.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from modcal_core.calibration.covariance import Uncertainty
from modcal_core.calibration.model import Instrument, Model
from modcal_core.calibration.parameters import ModelParameter
from modcal_core.calibration.prediction import TypicalDriver
from modcal_core.effects import Carried, Effect, NominalArm, Shape, require_known
from modcal_core.geometry import Array, se3
from modcal_core.measurements import shown
from modcal_core.measurements.kinds import kinds
from modcal_core.robots import (
    CarryingJoint,
    Chain,
    Delta,
    Follower,
    Hanging,
    HeldBehind,
    Inertias,
    Mechanism,
    delta_from_data,
    delta_to_data,
)


def effect_to_data(effect: Effect) -> dict[str, Any]:
    """An effect with its shape, sizes and their standard deviations."""
    return {
        "family": effect.family,
        "place": effect.place,
        "direction": effect.direction,
        "driver": effect.driver,
        "shape": {"kind": effect.shape.kind, **{k: float(v) for k, v in effect.shape.settings.items()}},
        "values": effect.values.tolist(),
        "std": effect.std.tolist(),
    }


def effect_from_data(data: Mapping[str, Any]) -> Effect:
    """The effect. Raises ValueError where its sizes are not those of its shape, BadTable for an unknown family."""
    shape = dict(data["shape"])
    effect = Effect(
        str(data["family"]),
        str(data["place"]),
        str(data["direction"]),
        str(data["driver"]),
        Shape(str(shape.pop("kind")), {str(k): float(v) for k, v in shape.items()}),
        _vector(data["values"]),
        np.array(data["std"], dtype=float).reshape(-1),
    )
    require_known(effect)
    missing = [name for name in effect.refined if name not in effect.shape.settings]
    if missing or len(effect.values) <= len(effect.refined) or len(effect.std) != len(effect.values):
        raise ValueError(f"effect {effect.family[:40]} has {len(effect.values)} values, or lacks {', '.join(missing)}")
    return effect


def _vector(values: Any) -> Array:
    """Finite numbers (m,). Raises ValueError for others."""
    out = np.array(values, dtype=float)
    if out.ndim != 1 or not np.isfinite(out).all():
        raise ValueError(f"{shown(values)} is not a list of finite numbers")
    return out


def typical_to_data(typical: TypicalDriver | None) -> dict[str, Any]:
    """What an effect was on average, under the key ``usual``; nothing where that is not known."""
    return {} if typical is None else {"usual": {"mean": typical.mean.tolist(), "cost_m2": float(typical.cost)}}


def typical_from_data(data: Any) -> TypicalDriver | None:
    """Typical driver from the entry ``usual``; None where there is none."""
    return None if data is None else TypicalDriver(_vector(data["mean"]), float(data["cost_m2"]))


def uncertainty_to_data(known: Uncertainty) -> dict[str, Any]:
    """The parameters, and the rows of the covariance up to the diagonal, a line of text each.

    As text, since there may be hundreds of thousands of numbers: a list of as many takes YAML ten times as long.
    """
    rows = known.covariance.tolist()
    return {
        "parameters": [
            {
                **{"name": p.name, "place": p.place, "direction": p.direction, "frame": p.frame},
                "prior": float(p.prior_std),
                **({"instrument": p.instrument, "unit": p.own_unit} if p.instrument >= 0 else {}),
            }
            for p in known.parameters
        ],
        "covariance": "".join(f"{' '.join(map(repr, row[: i + 1]))}\n" for i, row in enumerate(rows)),
    }


def uncertainty_from_data(data: Any, model: Model) -> Uncertainty | None:
    """The uncertainty of a calibrated model, or None. Raises ValueError for what is no covariance of its parameters."""
    if data is None:
        return None
    parameters = tuple(
        ModelParameter(
            *(str(p["name"]), int(p["place"]), int(p["direction"]), int(p["frame"]), float(p["prior"])),
            *(int(p.get("instrument", -1)), str(p.get("unit", ""))),
        )
        for p in data["parameters"]
    )
    rows = [np.array(line.split(), dtype=float) for line in data["covariance"].splitlines()]
    K = len(parameters) + sum(len(e.values) for e in model.effects)
    if [len(row) for row in rows] != list(range(1, K + 1)):
        raise ValueError(f"a covariance of {K} values has {K} rows of 1 to {K} numbers")
    lower = np.zeros((K, K))
    for i, row in enumerate(rows):
        lower[i, : i + 1] = row
    covariance = lower + np.tril(lower, -1).T
    if not np.isfinite(covariance).all() or (np.diag(covariance) < 0.0).any():
        raise ValueError("a covariance has finite numbers and no negative variance")
    return Uncertainty(parameters, covariance)


def arm_to_data(arm: NominalArm | None) -> dict[str, Any] | None:
    """The bodies of the nominal arm, which loads are computed from."""
    if arm is None or arm.inertias is None:
        return None
    held = arm.inertias.held
    return {
        "mass": arm.inertias.mass.tolist(),
        "com": arm.inertias.com.tolist(),
        "down": arm.inertias.down.tolist(),
        **({} if held is None else {"held": {"joints": held.joints, "mass": held.mass, "com": held.com.tolist()}}),
        **({"branches": [_hanging_to_data(b) for b in arm.inertias.branches]} if arm.inertias.branches else {}),
        **({} if arm.earlier is None else {"earlier": _carried_to_data(arm.earlier)}),
        **({} if arm.centre is None else {"centre": arm.centre.tolist()}),
    }


def _held_from_data(data: Any, joints: int) -> HeldBehind | None:
    if data is None:
        return None
    held = HeldBehind(int(data["joints"]), float(data["mass"]), np.array(data["com"], dtype=float).reshape(3))
    if not 0 < held.joints < joints or not np.isfinite([held.mass, *held.com]).all():
        raise ValueError("the arm is held behind none of its joints")
    return held


def _carried_to_data(carried: Carried) -> dict[str, Any]:
    return {
        "until": np.array(carried.until).tolist(),
        "mass": carried.mass.tolist(),
        "moment": carried.moment.tolist(),
    }


def carried_from_data(data: Any) -> Carried | None:
    """What the arm carried before what its bodies contain, or None."""
    kept = (data or {}).get("earlier")
    if kept is None:
        return None
    until = tuple(float(t) for t in kept["until"])
    mass = np.array(kept["mass"], dtype=float).reshape(len(until))
    moment = np.array(kept["moment"], dtype=float).reshape(len(until), 3)
    if list(until) != sorted(until) or not (np.isfinite(mass).all() and np.isfinite(moment).all()):
        raise ValueError("what was carried earlier is not in order of time, or not finite")
    return Carried(until, mass, moment)


def centre_from_data(data: Any) -> np.ndarray | None:
    """Where a payload that a recorded number states has its centre (3,) [m], or None."""
    kept = (data or {}).get("centre")
    if kept is None:
        return None
    centre = np.array(kept, dtype=float).reshape(3)
    if not np.isfinite(centre).all():
        raise ValueError("the centre of the payload is not finite")
    return centre


def _hanging_to_data(body: Hanging) -> dict[str, Any]:
    return {
        "carrier": body.carrier,
        "mass": float(body.mass),
        "com": body.com.tolist(),
        "steps": [
            {
                "origin": s.origin[:3].tolist(),
                "axis": s.axis.tolist(),
                "turns": s.turns,
                "joint": s.joint,
                "motion": [float(s.factor), float(s.offset)],
            }
            for s in body.steps
        ],
    }


def _hanging_from_data(data: Any) -> Hanging:
    steps = tuple(
        CarryingJoint(
            _transform(s["origin"]),
            np.array(s["axis"], dtype=float).reshape(3),
            bool(s["turns"]),
            str(s["joint"]),
            float(s["motion"][0]),
            float(s["motion"][1]),
        )
        for s in data["steps"]
    )
    return Hanging(int(data["carrier"]), steps, float(data["mass"]), np.array(data["com"], dtype=float).reshape(3))


def inertias_from_data(data: Any) -> Inertias | None:
    """The bodies of the nominal arm, their moments of inertia zero, or None."""
    if data is None:
        return None
    mass, com = np.array(data["mass"], dtype=float), np.array(data["com"], dtype=float)
    down = np.array(data["down"], dtype=float).reshape(3)
    branches = tuple(_hanging_from_data(b) for b in data.get("branches", ()))
    if not np.isfinite(down).all() or any(not 0 <= b.carrier < len(mass) for b in branches):
        raise ValueError("bodies beside the chain hang on none of its joints")
    held = _held_from_data(data.get("held"), len(mass))
    return Inertias(mass, com, np.zeros((len(mass), 3, 3)), branches, down, held)


def model_to_data(model: Model) -> dict[str, Any]:
    """Mechanism, frames, tool and instruments, without the effects."""
    chain = model.chain
    cell = {
        "frames": {name: T[:3].tolist() for name, T in zip(model.frames, model.T_frame_base, strict=True)},
        "tool": model.T_tip_tool[:3].tolist(),
        **({"instruments": [_instrument_to_data(i) for i in model.instruments]} if model.instruments else {}),
        **({"leaders": list(model.leaders)} if model.leaders else {}),
    }
    if isinstance(chain, Delta):
        return {"delta": delta_to_data(chain), **cell}
    chain = model.serial
    follows = {f.joint: {"joint": f.leader, "factor": f.factor, "offset": f.offset} for f in chain.follows}
    return {
        "base": chain.base,
        "tip": chain.tip,
        "joints": [
            {
                "name": name,
                "type": "revolute" if chain.revolute[k] else "prismatic",
                "origin": chain.origins[k][:3].tolist(),
                "axis": chain.axes[k].tolist(),
                "limits": [float(chain.lower[k]), float(chain.upper[k])],
                **({"follows": follows[k]} if k in follows else {}),
            }
            for k, name in enumerate(chain.names)
        ],
        "tip_origin": chain.origins[-1][:3].tolist(),
        **cell,
    }


def _instrument_to_data(instrument: Instrument) -> dict[str, Any]:
    return {
        "frame": instrument.frame,
        "kind": instrument.kind,
        "constants": instrument.values.tolist(),
        "target": None if instrument.target is None else instrument.target.tolist(),
    }


def _instrument_from_data(data: Mapping[str, Any], frames: Sequence[str]) -> Instrument:
    kind = kinds().get(str(data["kind"]))
    values = np.array(data["constants"], dtype=float)
    target = None if data["target"] is None else np.array(data["target"], dtype=float)
    if kind is None or data["frame"] not in frames or values.shape != kind.start().shape:
        raise ValueError(f"no instrument of kind {data['kind']} in frame {data['frame']} with {values.size} constants")
    return Instrument(str(data["frame"]), kind.name, values, target)


def model_from_data(data: Mapping[str, Any]) -> Model:
    """The model, without effects and without the arm that loads are computed from."""
    frames = tuple(str(name) for name in data["frames"])
    chain = _chain_from_data(data)
    return Model(
        chain,
        frames,
        np.stack([_transform(T) for T in data["frames"].values()]),
        _transform(data["tool"]),
        instruments=tuple(_instrument_from_data(i, frames) for i in data.get("instruments", ())),
        leaders=tuple(int(f) for f in data.get("leaders", ())),
    )


def _chain_from_data(data: Mapping[str, Any]) -> Mechanism:
    if "delta" in data:
        return delta_from_data(data["delta"], "calibration: delta")
    joints: Sequence[Mapping[str, Any]] = data["joints"]
    follows = tuple(
        Follower(k, str(f["joint"]), float(f["factor"]), float(f["offset"]))
        for k, joint in enumerate(joints)
        if (f := joint.get("follows")) is not None
    )
    chain = Chain.build(
        [str(j["name"]) for j in joints],
        [_transform(j["origin"]) for j in joints] + [_transform(data["tip_origin"])],
        [j["axis"] for j in joints],
        [j["type"] == "revolute" for j in joints],
        [j["limits"][0] for j in joints],
        [j["limits"][1] for j in joints],
        str(data["base"]),
        str(data["tip"]),
    )
    return replace(chain, follows=follows)


def _transform(rows: Any) -> Array:
    M = np.array(rows, dtype=float)
    if M.shape != (3, 4) or not np.isfinite(M).all():
        raise ValueError(f"expected 3 rows of 4 numbers, got shape {M.shape}")
    return se3.transform(M[:, :3], M[:, 3])
