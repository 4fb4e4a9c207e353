"""What calibrator and estimator say, as messages of modcal_interfaces, and a calibration read back from one.

The functions fill messages that they are given, so that this package needs no ROS. Figures come from the data of
report.json and check.json, in metres and radians here.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from modcal_core.calibration import fingerprint
from modcal_core.errors import BadTable
from modcal_core.geometry import Array, se3
from modcal_msgs_py.commands import fill_pose, require_version
from modcal_msgs_py.readings import set_nanoseconds, set_seconds

if TYPE_CHECKING:
    from modcal_core.articulation import TrackerState
    from modcal_core.correction import HeldBox, Placing, StackPlace
    from modcal_core.robots import Mechanism

_MOST = 200_000  # values of a calibration; one of an arm with all effects has some 2 000
_REMEDY = "publish it as the calibrator does"
_STATUS = {"open": 1, "at_floor": 2, "cannot_tell": 3}
_APPLY = {None: 0, False: 1, True: 2}
_CHECKED = {"unchanged": 1, "changed": 2, "ambiguous": 3, "unexplained": 4}


def fill_change(message: Any, data: Mapping[str, Any]) -> Any:
    """A Change with a change of check.json, or what the calibrator suspects.

    data: place, direction, driver, since_s, size_mm, size_deg, same_as, sentence, each where it is known.
    """
    message.changed = True
    for name in ("place", "direction", "driver", "sentence"):
        setattr(message, name, str(data.get(name) or ""))
    set_seconds(message.since, float(data.get("since_s") or 0.0))
    message.size_m = _thousandth(data.get("size_mm"))
    degrees = data.get("size_deg")
    message.size_rad = math.nan if degrees is None else math.radians(degrees)
    message.same_as = [str(place) for place in data.get("same_as") or ()]
    return message


def fill_identity(message: Any, chain: Mechanism | None, observers: Sequence[str]) -> Any:
    """An Identity of the described arm, which may be None, and of who looks at it."""
    if chain is not None:
        message.robot, message.base, message.tip = fingerprint(chain), chain.base, chain.tip
    message.observers = list(observers)
    return message


def fill_checked(message: Any, change: Callable[[], Any], data: Mapping[str, Any]) -> Any:
    """A Checked with the data of check.json. change: makes a Change."""
    message.status, message.sentence = _CHECKED[data["status"]], f"{data['verdict']} {data['advice']}"
    message.stations, message.action = int(data["stations"]), str(data["action"])
    message.error_m = _thousandth(data["error_mm"]["frozen"])
    for found in data["changes"]:
        moved, turned = found["moved_mm"]["rms"], found["turned_deg"]
        message.changes.append(fill_change(change(), {**found, "size_mm": moved, "size_deg": turned}))
    return message


def fill_estimate(message: Any, names: Sequence[str], values: Array, stds: Array) -> Any:
    """An Estimate of parameters by their names, with values and standard deviations (n,)."""
    message.names, message.values, message.stds = list(names), array("d", values), array("d", stds)
    return message


def fill_verdict(message: Any, data: Mapping[str, Any]) -> Any:
    """A Verdict with the data of report.json; what that does not hold is NaN, or empty."""
    message.status, message.apply = _STATUS.get(data.get("status", ""), 0), _APPLY[data.get("apply")]
    message.open_because = [str(why) for why in data.get("open_because") or ()]
    message.sentence = str(data.get("verdict") or "")
    message.effects = [f"{e['family']} at {e['place']}" for e in data.get("effects") or ()]
    claim = data.get("claim_mm") or {}
    message.claim.over = str(claim.get("over") or "")
    for name in ("mean", "rms", "p95", "max"):
        setattr(
            message.claim, f"{name}_m", [_thousandth(end) for end in (claim.get(name) or {}).get("ci95", (None, None))]
        )
    errors, left = data.get("error_mm") or {}, message.residuals
    left.stations = int((data.get("split") or {}).get("held_out") or 0)
    final = errors.get("final") or {}
    left.nominal_rms_m, left.geometric_rms_m = (
        _thousandth((errors.get(which) or {}).get("rms")) for which in ("nominal", "geometric")
    )
    left.rms_m, left.p95_m, left.max_m = (_thousandth(final.get(name)) for name in ("rms", "p95", "max"))
    left.floor_m = _thousandth(data.get("noise_floor_mm"))
    return message


def fill_object_status(message: Any, frame: str, stamp: int, state: TrackerState) -> Any:
    """An ObjectState with what is believed; a model that is none of an object leaves its numbers at zero."""
    message.header.frame_id = frame
    set_nanoseconds(message.header.stamp, stamp)
    message.trusted, message.event, message.written = state.trusted, state.event or "", str(state.written or "")
    message.rotations_of_handle, message.samples = state.follows, state.samples
    message.ahead_m, message.off_m = float(state.ahead_m), float(state.off_m)
    message.path_m, message.apart_m = float(state.path_m), float(state.apart_m)
    message.kinds, message.probabilities = list(state.probabilities), [float(p) for p in state.probabilities.values()]
    message.model.kind = state.kind
    if (model := state.model) is not None:
        told, handle = message.model, message.model.handle
        told.axis.x, told.axis.y, told.axis.z = model.axis.tolist()
        told.point.x, told.point.y, told.point.z = model.point.tolist()
        told.pitch, told.radius = float(model.pitch), float(model.radius) if model.turns else 0.0
        at, turn = handle.position, handle.orientation
        at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w = se3.to_pose(model.start).tolist()
    return message


def asked_of_box(request: Any) -> tuple[Array, StackPlace | None]:
    """(known size (3,) [m], NaN for what is not, and where the box shall stand) in a request of MeasureObject.

    Raises BadCommand for another version, BadTable for a place that is none.
    """
    from modcal_core.correction import StackPlace  # what measures boxes loads slowly, and few nodes are asked

    require_version(request, "measure_object")
    size = np.array([request.size.x, request.size.y, request.size.z])
    if not request.place:
        return np.where(size > 0.0, size, np.nan), None
    at, turn = request.stack.pose.position, request.stack.pose.orientation
    pose, spread = [at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w], np.reshape(request.stack.covariance, (6, 6))
    return np.where(size > 0.0, size, np.nan), StackPlace(
        pose, spread, request.down or "+z", request.corner, request.turn
    )


def fill_held_box(answer: Any, held: HeldBox, put: Placing | None, base: str) -> Any:
    """An answer of MeasureObject with a box in the gripper, and where it goes, in the base link."""
    answer.done, answer.frame, answer.box.header.frame_id = True, held.frame, held.frame
    set_seconds(answer.box.header.stamp, held.until)
    fill_pose(answer.box.pose, held.box.T_frame_box, held.pose_covariance)
    answer.size.x, answer.size.y, answer.size.z = held.box.size.tolist()
    answer.covariance = held.box.covariance.ravel()
    answer.message = f"box in {held.frame}; {held.box.spare} of its {len(held.read)} readings check it"
    if put is not None:
        answer.placing.header.frame_id = base
        fill_pose(answer.placing.pose, put.T_base_frame, put.covariance)
    return answer


def _thousandth(value: float | None) -> float:
    """A number in units of a thousandth; NaN for one that is not known."""
    return math.nan if value is None else 1e-3 * float(value)


# --- A calibration: the tree of its file, leaf by leaf, as parameters of rcl_interfaces


def fill_calibration(message: Any, parameter: Callable[[], Any], data: Mapping[str, Any]) -> Any:
    """A Calibration with the data of calibration.yaml. parameter: makes a Parameter."""
    message.robot = str(data.get("robot", ""))
    for path, value in _leaves(data):
        one = parameter()
        one.name = "/".join(path)
        _put(one.value, value)
        message.values.append(one)
    return message


def calibration_data(message: Any) -> dict[str, Any]:
    """The data of calibration.yaml in a Calibration. Raises BadCommand for another version, or BadTable."""
    require_version(message, "calibration")
    if len(message.values) > _MOST:
        raise BadTable("calibration", f"has {len(message.values)} values, {_MOST} is the limit", _REMEDY)
    root: dict[str, Any] = {}
    for one in message.values:
        path, node = one.name.split("/"), root
        for key in path[:-1]:
            node = node.setdefault(key, {})
            if not isinstance(node, dict):
                raise BadTable(f"calibration, {one.name}", "lies below a value", _REMEDY)
        node[path[-1]] = _got(one.value)
    tree = _tree(root)
    if not isinstance(tree, dict):
        raise BadTable("calibration", "is a list", _REMEDY)
    return tree


_NOTHING, _EMPTY, _ARRAYS = 0, 5, 5  # types of a value that is not set, and of an empty mapping; of arrays so much more
_KINDS: dict[type, tuple[int, str]] = {bool: (1, "bool"), int: (2, "integer"), float: (3, "double"), str: (4, "string")}
_READ = {code: f"{name}_value" for code, name in _KINDS.values()}
_READ |= {code + _ARRAYS: f"{name}_array_value" for code, name in _KINDS.values()}


def _leaves(value: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    if isinstance(value, Mapping) and value:
        for key, inner in value.items():
            yield from _leaves(inner, (*path, str(key).replace("~", "~0").replace("/", "~1").replace("[", "~2")))
    elif isinstance(value, list | tuple) and not _alike(value):
        for i, inner in enumerate(value):
            yield from _leaves(inner, (*path, f"[{i}]"))
    else:
        yield path, value


def _alike(values: list[Any] | tuple[Any, ...]) -> bool:
    """Whether a list is an array of numbers or of texts; an empty one is."""
    kinds = {type(value) for value in values}
    return not kinds or (len(kinds) == 1 and next(iter(kinds)) in _KINDS)


def _put(into: Any, value: Any) -> None:
    if isinstance(value, Mapping):
        into.type = _EMPTY
    elif value is not None:
        many = isinstance(value, list | tuple)
        one = (value[0] if value else "") if many else value
        into.type = _KINDS[type(one)][0] + _ARRAYS * many
        setattr(into, _READ[into.type], list(value) if many else value)


def _got(value: Any) -> Any:
    if value.type == _NOTHING:
        return None
    if value.type == _EMPTY:
        return {}
    if value.type not in _READ:
        raise BadTable("calibration", f"holds a value of type {value.type}", _REMEDY)
    got = getattr(value, _READ[value.type])
    return got if isinstance(got, bool | int | float | str) else list(got)


def _tree(node: Any) -> Any:
    if not isinstance(node, dict):
        return node
    indices = [f"[{i}]" for i in range(len(node))]
    if node and set(indices) == set(node):
        return [_tree(node[i]) for i in indices]
    return {key.replace("~2", "[").replace("~1", "/").replace("~0", "~"): _tree(inner) for key, inner in node.items()}
