"""The page of messages: of each topic of each node, what the fields of its message mean, and which are left alone.

Topics come from the running nodes, fields from the message types; only what they mean is written here. A topic without
a meaning, a meaning without a topic and a field that its type does not have end the making of the page.
"""

# ruff: noqa: E501 (a table of sentences)
from __future__ import annotations

from importlib import import_module

from graph import executables, opened
from markup import code, prose, table

STAMP = "time of the measurement, on one clock with the others"
ANY_FRAME = "a name of your own; each is a frame with an unknown place of its own"
JOINTS = {
    "header.stamp": STAMP,
    "header.frame_id": "not looked at",
    "name": "joints, in any order; others may be among them, or come in messages of their own",
    "position": "rad, m; NaN and values that no joint can have are left out and counted",
    "velocity": "rad/s, m/s; may be empty: then it is taken from the positions",
    "effort": "torque of the actuator on the joint, N m, N, friction included; may be empty",
}
POSE = {
    "header.stamp": STAMP,
    "header.frame_id": ANY_FRAME,
    "pose.position": "of the target, m",
    "pose.orientation": "unit quaternion x y z w of the target; zeros: target lost",
}
OWN_POSE = {"header.stamp": "of the joint states it follows from", "header.frame_id": "base link of the arm"}
WRENCH = {
    "header.stamp": STAMP,
    "header.frame_id": "link of the sensor",
    "wrench.force": "N, as the sensor feels it; tared at rest",
    "wrench.torque": "N m, about the frame's origin",
}
TRAJECTORY = {
    "header.stamp": "when it was sent",
    "joint_names": "of the arm, base to tip",
    "points": "one: positions, rad, m, and time_from_start",
}


def _length(frame: str, said: str) -> dict[str, str]:
    """What the fields of a Range message mean."""
    return {
        "header.stamp": STAMP,
        "header.frame_id": frame,
        "range": said,
        **dict.fromkeys(("radiation_type", "field_of_view", "min_range", "max_range", "variance"), "not looked at"),
    }


URDF = {"data": "a URDF; sent once and kept for whoever comes later"}
TEMPERATURE = {
    "header.stamp": STAMP,
    "header.frame_id": "the link or joint; the driver is called `temperature:FRAME`",
    "temperature": "°C",
    "variance": "not looked at",
}
CALIBRATION = {
    "header.frame_id": "base link of the arm",
    "robot": "whose calibration it is",
    "values": "the content of calibration.yaml, each number and text by its path",
}
CHANGE = {
    "header.stamp": "when it was found",
    "changed": "false: nothing is suspected, and the rest is empty",
    "place": "of the change; same_as: what would explain it as well",
    "size_m": "RMS of how far the tool is moved, m; size_rad: and turned",
    "sentence": "for a person",
}
OBJECT = {
    "header.stamp": "of the pose it follows from",
    "trusted": "whether the model may be followed",
    "event": "locked, jammed, changed; empty: nothing",
    "model": "kind, axis, pitch, radius and pose of the handle, in header.frame_id",
    "probabilities": "of the kinds",
    "ahead_m": "error of the last prediction, m; off_m: across the path",
}
MARKERS = {"markers": "in the base link; ns says what each group shows ([live view](../live_view.md))"}
# by topic, or by node and topic where one node means something else
MEANINGS: dict[str, dict[str, str]] = {
    "joint_states": JOINTS,
    "robot_description": URDF,
    "tracker/pose": POSE,
    "tracker/point": {"header.stamp": STAMP, "header.frame_id": ANY_FRAME, "point": "of the target, m"},
    "tracker/range": _length("the anchor: its origin is where the wire begins", "distance to the target, m"),
    "tracker/plane": _length("the plane z = 0", "height of the target above the plane, m; 0: it touches"),
    "gripper/range": _length("the sensor on the gripper", "length of its ray up to what it meets, m"),
    "tracker/bearing": {
        "header.stamp": STAMP,
        "header.frame_id": "the station, a frame of its own",
        "vector": "unit vector from the station to the target",
    },
    "temperature": TEMPERATURE,
    "wrench": WRENCH,
    "tool_pose": {
        **OWN_POSE,
        "pose.pose": "true pose of the tool, such as a corrector's `~/pose`, m and unit quaternion",
        "pose.covariance": "not looked at",
    },
    "calibration": CALIBRATION,
    "desired_pose": {
        "header.stamp": "when it was asked for; too old is refused; 0: now",
        "header.frame_id": "base link, or empty, or a tracker's frame that was calibrated",
        "pose.position": "where the target is to be in truth, m",
        "pose.orientation": "unit quaternion; anything else is refused",
    },
    "/clock": {"clock": "simulated time"},
    "/diagnostics": {
        "header.stamp": "when it was sent: once a second, and at once when a level changes",
        "status": "name `NODE: PART`, level OK, WARN or ERROR, message for a person, values by key; hardware_id is modcal",
    },
    "image": {
        "header.stamp": "when it was taken",
        "header.frame_id": "the camera",
        "encoding": "mono8, rgb8, bgr8, with alpha, yuv422 or bayer of 8 bits",
        "data": "rows of `step` bytes",
    },
    "image/compressed": {"header.stamp": "when it was taken", "format": "png or jpeg, 8 bits a channel", "data": "the file"},
    "camera_info": {
        "width": "of the images it is of, px",
        "height": "the same",
        "distortion_model": "plumb_bob",
        "k": "zero: not calibrated, and then no pose is published",
        "d": "up to five coefficients",
    },
    "corners": {
        "header.stamp": "when the image was taken",
        "fields": "u, v, sigma [px] (float32), id, image_width, image_height (uint32), as board_detector's `~/corners`",
        "data": "a point a corner",
    },
    "board_detector ~/corners": {
        "header.stamp": "of the image",
        "header.frame_id": "of the image",
        "fields": "u, v, sigma [px] (float32), id, image_width, image_height (uint32)",
        "data": "a point a corner; sigma from the image's own noise",
    },
    "board_detector ~/pose": {
        "header": "of the image",
        "pose.pose": "of the target in the camera, m and unit quaternion",
        "pose.covariance": "of the corners' noise; where the pose tilted the other way fits as well, it holds both",
    },
    "board_detector ~/coaching": {"data": "a line: how many corners, and what to do next"},
    "board_detector ~/annotated": {"encoding": "bgr8", "data": "the image with corners and that line; sent while somebody looks"},
    "calibrator ~/robot_description": {"data": "the trusted corrected URDF"},
    "calibrator ~/calibration": CALIBRATION,
    "calibrator ~/change": CHANGE,
    "calibrator ~/checked": {
        "status": "UNCHANGED, CHANGED, AMBIGUOUS, UNEXPLAINED ([check](../check.md))",
        "changes": "what has changed",
        "action": "advised, in one word",
        "error_m": "RMS of the trusted model on these stations, m",
    },
    "calibrator ~/report": {
        "status": "of the trusted model: OPEN, AT_FLOOR or CANNOT_TELL ([verdict](../verdict.md))",
        "apply": "NOT_JUDGED, DO_NOT_APPLY or APPLY",
        "claim": "lower and upper 95 % bound of the tool's error, m",
        "residuals": "on readings that no fit has seen, m",
    },
    "calibrator ~/residual": {"data": "held-out RMS of the last result, m"},
    "calibrator ~/residual_before": {"data": "the same of the model trusted before, m"},
    "calibrator ~/estimate": {"names": "of the parameters", "values": "m, rad or 1", "stds": "standard deviations of these"},
    "calibrator ~/trusted": {"data": "false while a change is suspected"},
    "corrector ~/joint_states": {
        "header.stamp": "of the joint states it follows from",
        "name": "joints of the calibration",
        "position": "true positions, with what effects do along the joints' axes, rad, m",
        "velocity": "as they were reported",
    },
    "corrector ~/joint_trajectory": {
        **TRAJECTORY, "points": "one: the positions, rad, m, that bring the target to the desired pose, and time_from_start",
    },
    "corrector ~/pose": {
        **OWN_POSE,
        "pose.pose": "true pose of the target",
        "pose.covariance": "x y z, then turns about the base's x y z, m², rad²: parameters, effects and scatter",
    },
    "corrector ~/robot_description": {"data": "the corrected URDF, beside the nominal one"},
    "articulation_estimator ~/expected_pose": {
        "header.stamp": "of the pose it follows from", "header.frame_id": "as of the input: base link, or the tracker's frame",
        "pose": "where the handle will be `lookahead_m` further on its path",
    },
    "articulation_estimator ~/object_axis": {"markers": "axis and path, in the frame of the input; sent while someone listens"},
    "articulation_estimator ~/object_description": {"data": "the object as a URDF with one joint, `object_joint`; empty: forgotten"},
    "articulation_estimator ~/object_state": {
        "header.stamp": "of the pose it follows from",
        "name": "`object_joint`",
        "position": "how far it is open since it was gripped, rad, m",
    },
    "articulation_estimator ~/object_status": OBJECT,
    "impedance_setpoint object_description": {"data": "of the estimator, a URDF of one joint; empty: no object"},
    "impedance_setpoint object_status": {**OBJECT, "header.stamp": "its age counts"},
    "impedance_setpoint ~/joint_references": {
        "positions": "of the arm's joints, base to tip, rad, m",
        "velocities": "rad/s, m/s",
        "time_from_start": "one period of the node's rate",
    },
    "impedance_setpoint ~/joint_trajectory": TRAJECTORY,
    "impedance_setpoint ~/target_pose": {
        "header.stamp": "of the tick", "header.frame_id": "base link of the arm", "pose": "setpoint of the tip, checked by the safety monitor",
    },
    "impedance_setpoint ~/target_stiffness": {
        "header.stamp": "of the tick", "header.frame_id": "tip link", "wrench": "stiffness to ask for, N/m and N m/rad by axis",
    },
    "impedance_setpoint ~/target_wrench": {
        "header.stamp": "of the tick", "header.frame_id": "tip link", "wrench": "force and torque to add, N and N m",
    },
    "acceleration_limits ~/lower": {
        "header.stamp": "of the joint states it is of",
        "joint_names": "of the arm, base to tip",
        "points": "one, with accelerations only, rad/s², m/s²: no controller takes it for a motion",
    },
    "acceleration_limits ~/upper": {
        "header.stamp": "of the joint states it is of",
        "joint_names": "of the arm, base to tip",
        "points": "one, with accelerations only, rad/s², m/s²",
    },
    "viewer calibrator/calibration": CALIBRATION,
    "viewer calibrator/change": {"sentence": "for a person"},
    "viewer ~/axes": MARKERS,
    "viewer ~/residuals": MARKERS,
    "viewer ~/stations": MARKERS,
    "viewer ~/uncertainty": MARKERS,
    "simulated_cell joint_trajectory": {
        "joint_names": "all joints of the arm, in any order",
        "points": "positions and time_from_start, rising; refused outside the limits",
    },
    "simulated_cell ~/true_tool": {**POSE, "header.frame_id": "`tracker`", "pose.orientation": "without noise"},
    "simulated_cell ~/true_tool_in_base": {
        **POSE, "header.frame_id": "base link", "pose.orientation": "without noise",
    },
    "simulated_furniture joint_references": {"positions": "of the arm's joints, base to tip, rad; the other fields are not looked at"},
    "simulated_furniture joint_trajectory": {"joint_names": "of the arm", "points": "positions and time_from_start"},
    "simulated_furniture ~/contact_force": {
        "header.stamp": STAMP, "header.frame_id": "the handle", "wrench": "the largest that hand and handle exerted on each other since the last message, N, N m",
    },
    "simulated_furniture ~/object_truth": {
        "header.stamp": STAMP, "name": "the object's joint", "position": "how far it is open in truth, rad, m",
    },
    "door_demo simulated_furniture/object_truth": {"position": "how far it is open in truth, rad, m", "name": "not looked at"},
    "door_demo simulated_furniture/contact_force": {"wrench.force": "N; the largest is said in the end"},
    "door_demo joint_states": {"header.stamp": STAMP, "name": "of the arm", "position": "rad, m; the way of the hand is learned from"},
    "trajectory_sender ~/joint_trajectory": TRAJECTORY,
    "station_runner ~/joint_trajectory": {
        "header.stamp": "zero: from now on",
        "joint_names": "of the arm, base to tip",
        "points": "positions, velocities and time_from_start of the way to a station, at rest at its end; a single point holds the arm",
    },
}  # fmt: skip
SERVICES = {
    "std_srvs/srv/Trigger": "asks nothing; `success` and `message` say what was done, or why not",
    "modcal_interfaces/srv/MeasureObject": "measures the box in the gripper, and says where to put it down",
    "modcal_interfaces/action/Solve": "calibrates from what was received; cancelled, it leaves the trusted model",
    "modcal_interfaces/action/Check": "says what has changed since the trusted model was made",
    "modcal_interfaces/action/Pull": "pulls what the arm holds; cancelled, it lets go",
    "modcal_interfaces/action/Measure": "accepts the dry run and measures; cancelled, the arm is held",
    "lifecycle_msgs": "of every lifecycle node: configure, activate, deactivate, clean up, shut down",
}

INTRODUCTION = """# Messages

What each node hears and says, field by field. Units are SI, quaternions x y z w, frames as REP 103 and 105 have them; a field
that is not named is left at its default, or not looked at. QoS and the parameters on which a topic depends are on the page
of [topics](topics.md), what nodes are for in [nodes.md](../nodes.md). In a bag the same topics stand with a leading `/`; what else
a bag may hold is in [recordings.md](../recordings.md)."""


def page() -> str:
    """Text of the page. Raises ValueError where meanings, topics and types do not go together."""
    parts, used = [INTRODUCTION], set[str]()
    for node in executables():
        parts.append(f"## {node}")
        for kind, title in (("subscribes to", "hears"), ("publishes", "says")):
            rows: list[tuple[str, ...]] = []
            for name, type_name in sorted({(o.name, o.type) for o in opened(node) if o.kind == kind}):
                key = next((k for k in (f"{node} {name}", name) if k in MEANINGS), None)
                if key is None:
                    raise ValueError(f"{node} {title} {name}: say in {__file__} what it means")
                used.add(key)
                for i, (field, meaning) in enumerate(MEANINGS[key].items()):
                    if not has(type_name, field):
                        raise ValueError(f"{key}: {type_name} has no field {field}")
                    rows.append((code(name) if not i else "", type_name if not i else "", code(field), _said(meaning)))
            if rows:
                parts.append(table((title, "type", "field", ""), rows))
        served = sorted({(o.name, o.type) for o in opened(node) if o.kind in ("serves", "performs", "asks for")})
        if served:
            rows_served = [
                (code(name), kind, SERVICES.get(kind, SERVICES.get(kind.split("/")[0], ""))) for name, kind in served
            ]
            parts.append(table(("services and actions", "type", ""), rows_served))
        if node == "recorder":
            parts.append(
                "It hears whatever its parameter `topics` names, of any type, and writes each message as it came."
            )
    unused = set(MEANINGS) - used
    if unused:
        raise ValueError(f"no node opens {', '.join(sorted(unused))}")
    return "\n\n".join(parts) + "\n"


def has(type_name: str, field: str) -> bool:
    """Whether a message type has this field, by dots."""
    package, _, name = type_name.split("/")
    fields = getattr(import_module(f"{package}.msg"), name).get_fields_and_field_types()
    first, _, rest = field.partition(".")
    if first not in fields:
        return False
    return not rest or has(_whole(fields[first]), rest)


def _whole(type_name: str) -> str:
    package, _, name = type_name.rpartition("/")
    return f"{package.removesuffix('/msg')}/msg/{name}"


def _said(meaning: str) -> str:
    """A cell: prose, but for links and code, which may stand in it."""
    return meaning if "](" in meaning or "`" in meaning else prose(meaning)
