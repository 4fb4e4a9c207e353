"""A joint as a URDF that any tool shows: a world link, one joint ``object_joint``, and the handle's link.

A URDF joint moves along or about an axis through its own origin, so the origin is put where the joint's model has it:

* rigid (fixed) and prismatic: at the handle's start, axis in the handle's frame.
* revolute: on the axis, next to the handle, turned as the handle; a fixed ``object_grasp`` leads on to the handle.
* screw: URDF has none. The turn ``object_joint`` carries a slide ``object_rise`` along the same axis, which mimics
  it with multiplier pitch. Turn and slide along one axis commute, so this is exact, for whoever minds mimic joints.

Between limits given by the configurations that were seen, else by what such joints do (a turn either way, 2 m).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from lxml import etree

from modcal_core.articulation.joint_motion import InUrdf
from modcal_core.articulation.joints import JointModel
from modcal_core.articulation.models.registry import AXES, axis_model
from modcal_core.errors import BadRobot
from modcal_core.geometry import Array, se3, so3

JOINT = "object_joint"
_MAX_TEXT = 100_000  # characters, some hundred times what describe writes
_RISE, _GRASP = "object_rise", "object_grasp"
_SLIDE = InUrdf("prismatic")


def describe(
    model: JointModel,
    world: str = "world",
    handle: str = "object_handle",
    limits: tuple[float, float] | None = None,
) -> str:
    """URDF text of a joint, from link ``world`` to link ``handle``; ``read`` is its inverse.

    limits: lower and upper configuration [rad or m], None for as far as such joints go. Raises BadRobot where lower
    is not below upper, or world and handle are one name.
    """
    written = axis_model(model.kind).urdf or InUrdf("fixed")
    low, high = limits if limits is not None else (-written.reach, written.reach)
    if world == handle or not world or not handle:
        said = "are not two different names"
        raise BadRobot(f"links {world!r} and {handle!r}", said, "name the frame of the track and the handle")
    if model.moves and not (np.isfinite([low, high]).all() and low < high):
        raise BadRobot(f"limits {low:g} to {high:g}", "do not rise", "give the lower one first")
    robot = etree.Element("robot", name="object")
    etree.SubElement(robot, "link", name=world)
    T, R = model.start, model.start[:3, :3]
    axis = R.T @ model.axis
    if not model.turns:
        joint = _joint(robot, JOINT, written.type, world, handle, T)
        if model.moves:
            _moving(joint, axis, low, high)
        etree.SubElement(robot, "link", name=handle)
        return _text(robot, model)
    on_axis = se3.transform(R, model.point)
    last = f"{handle}_axis"
    etree.SubElement(robot, "link", name=last)
    _moving(_joint(robot, JOINT, written.type, world, last, on_axis), axis, low, high)
    if model.rises:
        etree.SubElement(robot, "link", name=f"{handle}_rise")
        ends = sorted((low * model.pitch, high * model.pitch))
        rise = _joint(robot, _RISE, _SLIDE.type, last, f"{handle}_rise", np.eye(4))
        _moving(rise, axis, ends[0], ends[1])
        etree.SubElement(rise, "mimic", joint=JOINT, multiplier=repr(float(model.pitch)), offset="0.0")
        last = f"{handle}_rise"
    _joint(robot, _GRASP, "fixed", last, handle, se3.inverse(on_axis) @ T)
    etree.SubElement(robot, "link", name=handle)
    return _text(robot, model)


def read(text: str) -> JointModel:
    """The joint that a text from ``describe`` tells of. Raises BadRobot for any other text."""
    if len(text) > _MAX_TEXT:
        said = f"has {len(text)} characters, {_MAX_TEXT} is the limit"
        raise BadRobot("object_description", said, "publish what describe wrote")
    try:
        robot = etree.fromstring(text.encode(), etree.XMLParser(resolve_entities=False, no_network=True))
    except (etree.XMLSyntaxError, ValueError) as error:
        raise BadRobot("object_description", f"is not XML ({error})", "publish what describe wrote") from error
    joints = {joint.get("name"): joint for joint in robot.findall("joint")}
    main = joints.get(JOINT)
    types = {m.joint for m in AXES.values() if main is not None and m.urdf and m.urdf.type == main.get("type")}
    made = next((t for t in types if len(types) == 1 or t.rises == (_RISE in joints)), None)
    if main is None or made is None:
        raise BadRobot("object_description", f"has no {JOINT} that is fixed, prismatic or revolute", "use describe")
    oriented = robot.get("oriented", "true") != "false"
    T = _origin(main)
    if not made.moves:
        return made(T, np.array([0.0, 0.0, 1.0]), np.zeros(3), 0.0, oriented)
    axis = T[:3, :3] @ _numbers(main, "axis", "xyz", "1 0 0")
    axis = axis / max(float(np.linalg.norm(axis)), 1e-12)
    if not made.turns:
        return made(T, axis, np.zeros(3), 0.0, oriented)
    pitch = 0.0
    if made.rises:
        mimic = joints[_RISE].find("mimic")
        if mimic is None:
            raise BadRobot(f"object_description, {_RISE}", "mimics nothing", "publish what describe wrote")
        pitch = _number(mimic.get("multiplier", "1"))
    if _GRASP not in joints:
        raise BadRobot("object_description", f"has no {_GRASP}", "publish what describe wrote")
    return made(T @ _origin(joints[_GRASP]), axis, T[:3, 3], pitch, oriented)


def frames(text: str) -> tuple[str, str]:
    """Names of the world link and of the handle's, of a text from ``describe``. Raises BadRobot as ``read``."""
    read(text)
    joints: dict[Any, Any] = {joint.get("name"): joint for joint in etree.fromstring(text.encode()).findall("joint")}
    last = joints.get(_GRASP, joints[JOINT])
    try:
        return str(joints[JOINT].find("parent").get("link")), str(last.find("child").get("link"))
    except AttributeError as error:
        raise BadRobot("object_description", "has a joint without parent or child", "use describe") from error


def _joint(robot: Any, name: str, kind: str, parent: str, child: str, T: Array) -> Any:
    joint = etree.SubElement(robot, "joint", name=name, type=kind)
    etree.SubElement(joint, "origin", xyz=_written(T[:3, 3]), rpy=_written(so3.to_rpy(T[:3, :3])))
    etree.SubElement(joint, "parent", link=parent)
    etree.SubElement(joint, "child", link=child)
    return joint


def _moving(joint: Any, axis: Array, low: float, high: float) -> None:
    etree.SubElement(joint, "axis", xyz=_written(axis))
    etree.SubElement(joint, "limit", lower=repr(float(low)), upper=repr(float(high)), effort="100.0", velocity="1.0")


def _written(values: Array) -> str:
    return " ".join(repr(float(v)) for v in values)


def _text(robot: Any, model: JointModel) -> str:
    if not model.oriented:
        robot.set("oriented", "false")  # readers of URDF pass over attributes that they do not know
    return etree.tostring(robot, pretty_print=True, encoding="unicode")


def _origin(joint: Any) -> Array:
    rpy = _numbers(joint, "origin", "rpy", "0 0 0")
    return se3.transform(so3.from_rpy(rpy), _numbers(joint, "origin", "xyz", "0 0 0"))


def _numbers(joint: Any, tag: str, key: str, default: str) -> Array:
    element = joint.find(tag)
    values = (default if element is None else element.get(key, default)).split()
    if len(values) != 3:
        raise BadRobot(f"object_description, {tag} {key}", "is not three numbers", "publish what describe wrote")
    return np.array([_number(v) for v in values])


def _number(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise BadRobot(f"object_description, {text!r}", "is not a finite number", "publish what describe wrote")
    return value
