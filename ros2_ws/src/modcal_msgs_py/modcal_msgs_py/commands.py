"""Wishes, joint states and poses as they come over the wire, checked at the door; what is believed, as it goes out.

A picture begins with a marker that deletes all others of its topic: whoever listens from now on sees what one who has
listened for hours sees. Stamps are zero, which RViz and Foxglove take for *the newest transform*: what is latched must
be shown in a moving cell as well, long after it was said. ``marker`` is the Marker type.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from modcal_core.errors import BadCommand, ModcalError
from modcal_core.geometry import Array, se3, so3
from modcal_core.robots import Follower, JointColumns
from modcal_msgs_py.readings import nanoseconds, seconds, set_nanoseconds, set_seconds

if TYPE_CHECKING:
    from modcal_core.articulation import JointModel, TrackerState
    from modcal_core.impedance import ArmSetpoint

_UNIT, _NEARLY_UNIT = 1e-3, 0.02  # by how much a quaternion may be longer or shorter than one: of a wish, of a handle
_FASTEST = 100.0  # rad/s or m/s
_BEYOND = 0.1  # rad or m outside the limits that a joint may be reported


def desired_pose(message: Any, farthest: float) -> Array:
    """The pose (4, 4) [m] of a PoseStamped; raises BadCommand for one that is no pose.

    farthest: no sensible position is this far from its frame's origin [m].
    """
    numbers = _pose_numbers(message.pose, "desired_pose", _UNIT)
    far = math.hypot(*numbers[:3])
    if far > farthest:
        unit = "; it looks like millimetres" if far > 50.0 * farthest else ""
        raise BadCommand("desired_pose", f"is {far:.4g} m away, the arm reaches {farthest:.3g} m{unit}", "send metres")
    return se3.from_pose(numbers)


def _pose_numbers(pose: Any, what: str, off: float) -> Array:
    """x y z qx qy qz qw of a Pose. Raises BadCommand, naming ``what``, for what is not finite or no unit quaternion.

    off: how far from one the length of the quaternion may be.
    """
    p, q = pose.position, pose.orientation
    numbers = _finite([p.x, p.y, p.z, q.x, q.y, q.z, q.w], what)
    length = math.hypot(*numbers[3:])
    if abs(length - 1.0) > off:
        raise BadCommand(what, f"its quaternion has length {length:.4g}", "send a unit quaternion x y z w")
    return numbers


VERSION = 1  # of every type of modcal_interfaces that is read here


def require_version(message: Any, what: str) -> None:
    """Raises BadCommand, naming ``what``, for a message of another version of modcal_interfaces."""
    if message.version != VERSION:
        said = f"has version {message.version}, {VERSION} is read"
        raise BadCommand(what, said, "build modcal_interfaces of the same release on both sides")


def require_new(message: Any, now: float, stale: float) -> None:
    """Raises BadCommand for a stamped wish that is too old, or from another clock; one without a stamp is of now."""
    stamp = seconds(message.header.stamp) or now
    _require_recent("desired_pose", stamp, now, stale, "stamp it with this clock when it is sent")


def _require_recent(what: str, stamp: float, now: float, stale: float, remedy: str) -> None:
    if not abs(now - stamp) <= stale:
        when = "old" if stamp < now else "ahead"
        raise BadCommand(what, f"its stamp is {abs(now - stamp):.3g} s {when}, {stale:g} s is the limit", remedy)


class JointInput:
    """The newest position, velocity and effort of every joint of an arm, from messages in any order and any parts."""

    def __init__(self, names: Sequence[str], lower: Array, upper: Array, follows: Sequence[Follower] = ()) -> None:
        """Wait for these joints; positions far outside the limits are refused.

        follows: those that mimic another one, and stand where that one puts them unless a message names them.
        """
        self.names, self._follows = tuple(names), tuple(follows)
        self._lower, self._upper = lower - _BEYOND, upper + _BEYOND
        self._told: tuple[str, ...] | None = None  # names of the last message ...
        self._named = JointColumns.of(self.names, (), ())  # ... and which of them are which of this arm's joints,
        self._low, self._high = self._lower[:0], self._upper[:0]  # with their limits
        self.complete = False  # whether every joint has a message
        n = len(self.names)
        self.position, self.velocity, self.effort = np.zeros(n), np.zeros(n), np.full(n, math.nan)
        self.stamps = np.full(n, -math.inf)
        self._exact = np.zeros(n, dtype=np.int64)  # the same in nanoseconds

    def receive(self, message: Any, now: float, stale: float) -> None:
        """Take a JointState received at ``now`` [s]. Raises BadCommand for one that is wrong or older than ``stale``.

        Joints of other arms are passed over; a message without a stamp counts as sent when it was received.
        """
        stamp = seconds(message.header.stamp) or now
        remedy = "make the driver stamp with this clock, or check why it is late"
        _require_recent("joint_states", stamp, now, stale, remedy)
        names = tuple(message.name)
        if names != self._told:
            self._told = None
            self._named = JointColumns.of(self.names, self._follows, names)
            self._low, self._high = self._lower[self._named.joints], self._upper[self._named.joints]
        if len(message.position) != len(names) or (self._told is None and len(set(names)) != len(names)):
            raise BadCommand(
                "joint_states", f"{len(message.position)} positions for {len(names)} names", "send as many"
            )
        self._told = names
        named, column = self._named, self._named.joints
        if not len(column):
            return
        q = named.positions(np.asarray(message.position, dtype=float))
        within = (q >= self._low) & (q <= self._high)  # NaN is neither
        if not within.all():
            worst = int(np.argmin(within))
            said = f"{q[worst]:.4g} is far outside its limits"
            raise BadCommand(
                f"joint_states of {self.names[column[worst]]}", said, "send radians and metres of this robot"
            )
        self.position[column] = q
        self.stamps[column] = stamp
        self._exact[column] = nanoseconds(message.header.stamp) or round(1e9 * now)
        velocity, effort = (np.asarray(told, dtype=float) for told in (message.velocity, message.effort))
        self.velocity[column] = named.velocities(velocity) if len(velocity) == len(names) else 0.0
        self.effort[column] = named.efforts(effort) if len(effort) == len(names) else math.nan
        # no joint goes this fast: a driver that sends it does not know, and then nothing is made of it
        slow = np.abs(self.velocity) < _FASTEST
        if not slow.all():
            self.velocity[~slow] = 0.0
        self.complete = self.complete or not self.missing()

    @property
    def stamp(self) -> int:
        """The oldest of the stamps [ns], once every joint has one."""
        return int(self._exact.min())

    def missing(self) -> tuple[str, ...]:
        """Joints without any message so far."""
        return tuple(name for name, stamp in zip(self.names, self.stamps, strict=True) if stamp == -math.inf)

    def require_fresh(self, now: float, stale: float) -> None:
        """Raises BadCommand unless every joint was received within ``stale`` seconds of ``now``."""
        if self._told is None:
            raise BadCommand("joint_states", "no message was received", "check that the driver is alive")
        if missing := self.missing():
            raise BadCommand("joint_states", f"do not contain {', '.join(missing)}", "publish every joint of the arm")
        age = np.abs(now - self.stamps)
        j = int(np.argmax(age))
        if not age[j] <= stale:
            said = f"are {age[j]:.3g} s off, {stale:g} s is the limit"
            raise BadCommand(f"joint_states of {self.names[j]}", said, "check that the driver is alive, and its clock")


def fill_pose(message: Any, T: Array, covariance: Array | None = None) -> None:
    """Write a pose (4, 4) into a Pose, or with its covariance (6, 6) into a PoseWithCovariance."""
    pose = message if covariance is None else message.pose
    x, y, z, qx, qy, qz, qw = (float(v) for v in se3.to_pose(T))
    pose.position.x, pose.position.y, pose.position.z = x, y, z
    pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w = qx, qy, qz, qw
    if covariance is not None:
        message.covariance = [float(v) for v in covariance.ravel()]


def fill_accelerations(message: Any, names: Sequence[str], values: Array, stamp: int) -> None:
    """Write bounds of accelerations (n,) by joint into a JointTrajectory with one point.

    The point holds no positions, so that no controller takes it for a motion.
    """
    message.joint_names = list(names)
    message.points[0].accelerations = [float(v) for v in values]
    set_nanoseconds(message.header.stamp, stamp)


# --- Setpoints of an impedance as the messages that stacks take, wrenches both ways, and the estimate of an object

_LATE = 0.25  # s: a hand that is led at 6 cm/s goes 15 mm meanwhile, and a busy machine holds a message up for less
_LONGEST_URDF = 100_000  # characters of a description with one joint


def wrench_numbers(message: Any) -> Array:
    """Force and moment (6,) [N, N m] of a WrenchStamped."""
    f, m = message.wrench.force, message.wrench.torque
    return np.array([f.x, f.y, f.z, m.x, m.y, m.z], dtype=float)


def fill_wrench(message: Any, frame: str, stamp: int, numbers: Array) -> Any:
    """A WrenchStamped, filled with six numbers along and about the axes of a frame."""
    message.header.frame_id = frame
    set_nanoseconds(message.header.stamp, stamp)
    f, m = message.wrench.force, message.wrench.torque
    f.x, f.y, f.z, m.x, m.y, m.z = (float(x) for x in numbers)
    return message


def fill_point(message: Any, setpoint: ArmSetpoint, after: float, with_speed: bool = True) -> Any:
    """A JointTrajectoryPoint of the joints, to be reached so many seconds after it was sent.

    with_speed: false where it is the end of a trajectory, which controllers want to stand at.
    """
    message.positions = setpoint.q.tolist()
    message.velocities = setpoint.velocity.tolist() if with_speed else []
    set_seconds(message.time_from_start, after)
    return message


class ObjectInput:
    """What is believed of the object: ``model``, ``trusted``, ``event``, from the messages that tell of it.

    A description alone is not trusted: its status must say so, and be no older than ``stale`` [s]. One in another frame
    than the arm's base is no model: the numbers would be followed at another place.
    """

    def __init__(
        self, read: Callable[[str], JointModel], frames: Callable[[str], tuple[str, str]], stale: float = 1.0
    ) -> None:
        """read, frames: the model of a URDF text, and its first link and last; may raise ModcalError."""
        self._read, self._frames, self._stale = read, frames, stale
        self._model: JointModel | None = None
        self._frame, self._base = "", ""
        self.kind = ""
        self.event: str | None = None
        self._trusted, self._stamp, self._now = False, -math.inf, 0.0
        self._heard = self._apart = -math.inf  # when the last status came, and after how long [s]
        self._text = ""

    def hear_description(self, message: Any) -> None:
        """Take the URDF of the object. Raises ModcalError, and believes in no model, for one that is none."""
        text = str(message.data)
        if text == self._text:
            return
        self._text, self._model = text, None
        if not text:
            return
        if len(text) > _LONGEST_URDF:
            raise BadCommand("object_description", f"has {len(text)} characters", "publish a URDF of one joint")
        try:
            self._frame = self._frames(text)[0]
            self._model = self._read(text)
        except ModcalError:
            raise
        except (ValueError, KeyError, TypeError) as error:
            raise BadCommand("object_description", f"cannot be read ({error})", "publish a URDF of one joint") from None
        if self.elsewhere:
            raise BadCommand("object_description", self.elsewhere, "track the handle in the arm's base link")

    def in_base(self, base: str) -> None:
        """Believe from now on only in what is described in this link."""
        self._base = base

    @property
    def model(self) -> JointModel | None:
        """How the tool moves, in the arm's base; None where that is not known."""
        return None if self.elsewhere else self._model

    @property
    def elsewhere(self) -> str:
        """As text, that what was described is in another frame than the arm's base; empty where it is not."""
        if self._model is None or not self._base or self._frame == self._base:
            return ""
        return f"is in frame '{self._frame}', the arm begins at '{self._base}'"

    def hear_status(self, message: Any, now: float) -> None:
        """Take an ObjectState: whether the model is trusted, and what happened to the object. Raises BadCommand for one
        of another version.
        """
        require_version(message, "object_status")
        stamp = seconds(message.header.stamp) or now
        self._heard, self._apart = now, now - self._heard
        self._stamp = stamp if abs(now - stamp) <= self._stale else -math.inf
        self._trusted, self.kind = bool(message.trusted), str(message.model.kind)
        self.event = str(message.event) or None

    def at(self, now: float) -> ObjectInput:
        """Itself, as believed at a time [s]."""
        self._now = now
        return self

    @property
    def trusted(self) -> bool:
        """Whether the model is trusted at the time of :meth:`at`."""
        return self._trusted and self.model is not None and not self.silent

    @property
    def late(self) -> bool:
        """Whether the heartbeat is late: no status for longer than _LATE, and than three used to take."""
        return self._now - self._heard > max(_LATE, 3.0 * min(self._apart, self._stale))

    @property
    def silent(self) -> bool:
        """Whether no status was received for ``stale`` [s] before the time of :meth:`at`."""
        return not abs(self._now - self._stamp) <= self._stale


# --- What is seen of a handle, from messages, and what is believed of its joint, as messages that any tool shows

_PATH_POINTS = 40
_COLOURS = {True: (0.12, 0.44, 0.92), False: (0.69, 0.72, 0.76)}  # trusted, not yet


def seen(message: Any, what: str) -> tuple[Array, Array | None, float]:
    """Position (3,) [m], rotation (3, 3) or None, and stamp [s] of a pose or point with a header.

    Takes PoseStamped, PoseWithCovarianceStamped and PointStamped. Raises BadCommand, naming ``what``, for what is not
    finite, no unit quaternion, or not stamped.
    """
    stamp = seconds(message.header.stamp)
    if stamp <= 0.0:
        raise BadCommand(what, "has no stamp", "make its publisher stamp it")
    if hasattr(message, "point"):
        return _finite([message.point.x, message.point.y, message.point.z], what), None, stamp
    pose = message.pose.pose if hasattr(message.pose, "pose") else message.pose
    numbers = _pose_numbers(pose, what, _NEARLY_UNIT)
    return numbers[:3], so3.from_quaternion(numbers[3:]), stamp


def _finite(values: list[float], what: str) -> Array:
    numbers = np.array(values, dtype=float)
    if not np.isfinite(numbers).all():
        raise BadCommand(what, "is not finite", "send numbers")
    return numbers


def fill_object_state(message: Any, frame: str, stamp: int, configuration: float) -> Any:
    """A JointState of the object's one joint [rad or m]."""
    message.header.frame_id = frame
    set_nanoseconds(message.header.stamp, stamp)
    from modcal_core.articulation import JOINT  # loads SciPy, which a corrector does without

    message.name, message.position = [JOINT], [float(configuration)]
    return message


def status_values(state: TrackerState) -> dict[str, str]:
    """What is believed, as the keys and values of a DiagnosticStatus."""
    return {
        "kind": state.kind,
        "trusted": str(state.trusted).lower(),
        "event": state.event or "none",
        "ahead_m": f"{state.ahead_m:.6f}",
        "off_m": f"{state.off_m:.6f}",
        "samples": str(state.samples),
        "apart_m": f"{state.apart_m:.6f}",
        "path_m": f"{state.path_m:.6f}",
        "rotations": "handle" if state.follows else "grasp",
        "written": str(state.written or "as expected"),
        **{f"probability_{kind}": f"{p:.4f}" for kind, p in state.probabilities.items()},
    }


def fill_posed(message: Any, frame: str, stamp: int, T: Array) -> Any:
    """A PoseStamped of a pose (4, 4), or a PointStamped of its place."""
    message.header.frame_id = frame
    set_nanoseconds(message.header.stamp, stamp)
    if hasattr(message, "point"):
        message.point.x, message.point.y, message.point.z = T[:3, 3].tolist()
    else:
        fill_pose(message.pose, T)
    return message


def fill_joints(message: Any, names: Sequence[str], stamp: int, *columns: Array | None) -> Any:
    """A JointState of these joints. columns: positions, velocities and efforts (n,), as many as there are."""
    set_nanoseconds(message.header.stamp, stamp)
    message.name = list(names)
    for part, values in zip(("position", "velocity", "effort"), columns, strict=False):
        setattr(message, part, () if values is None else array("d", values))
    return message


def fill_markers(message: Any, marker: Any, frame: str, stamp: int, model: JointModel, reach: tuple[float, float],
                 trusted: bool) -> Any:  # fmt: skip
    """A MarkerArray with the joint's axis as an arrow and the handle's path as a line; blue once it is trusted.

    marker: the Marker type. reach: configurations between which the path is drawn.
    """
    handle = model.start[:3, 3]
    at = model.point if model.turns else handle
    length = 0.3 if not model.turns else max(0.2, 0.5 * min(model.radius, 1.0))
    shapes, colour = (marker.ARROW, marker.LINE_STRIP), (*_COLOURS[trusted], 1.0)
    arrow, line = (_shape(marker, shape, "object", colour) for shape in shapes)
    for number, one in enumerate((arrow, line)):
        one.header.frame_id, one.id, one.frame_locked = frame, number, False
        set_nanoseconds(one.header.stamp, stamp)
    arrow.scale.x, arrow.scale.y, arrow.scale.z = 0.01, 0.02, 0.03  # shaft, head, length of the head
    line.scale.x = 0.005
    arrow.points = [as_point(arrow, at), as_point(arrow, at + length * model.axis)]
    line.points = [as_point(line, p) for p in model.position(np.linspace(*reach, _PATH_POINTS))]
    if not model.moves:
        arrow.action = line.action = marker.DELETE
    message.markers = [arrow, line]
    return message


def as_point(marker: Any, p: Array) -> Any:
    """A Point, of the type that a Marker's pose has."""
    point = type(marker.pose.position)()
    point.x, point.y, point.z = (float(v) for v in p)
    return point


# --- Arrows, ellipsoids, dots and texts as markers, each message a whole picture that replaces the one before

Colour = tuple[float, float, float, float]  # red, green, blue, how solid: 0 to 1
_THINNEST = 1e-5  # m; viewers complain of what has no extent
_GROWING = ((0.13, 0.44, 0.71), (0.98, 0.78, 0.18), (0.84, 0.15, 0.16))  # blue, yellow, red


def colour_of(share: float, solid: float = 1.0) -> Colour:
    """Colour scale from blue (0) through yellow to red (1 and more), distinct for most colour-blind readers."""
    at = 2.0 * float(np.clip(share, 0.0, 1.0))
    low, high = _GROWING[int(at)], _GROWING[min(int(at) + 1, 2)]
    red, green, blue = (a + (at - int(at)) * (b - a) for a, b in zip(low, high, strict=True))
    return red, green, blue, solid


def fill_picture(message: Any, marker: Any, frame: str, parts: Sequence[Any], lifetime: float = 0.0) -> Any:
    """A MarkerArray that shows these markers and nothing else, in one frame.

    lifetime: [s] after which they vanish by themselves; 0: never. No parts: an empty picture.
    """
    begin = marker()
    begin.action = marker.DELETEALL
    for number, part in enumerate(parts):
        part.id = number
        set_seconds(part.lifetime, lifetime)
    message.markers = [begin, *parts]
    for part in message.markers:
        part.header.frame_id = frame
    return message


def arrows(
    marker: Any, space: str, starts: Array, vectors: Array, colours: Sequence[Colour], thickness: float
) -> list[Any]:
    """Arrows from each start (N, 3) along each vector (N, 3) [m], of a shaft so thick [m]. space: their namespace."""
    out = []
    for start, vector, colour in zip(starts, vectors, colours, strict=True):
        one = _shape(marker, marker.ARROW, space, colour)
        head = min(3.0 * thickness, 0.5 * float(np.linalg.norm(vector)))
        one.scale.x, one.scale.y, one.scale.z = thickness, 2.0 * thickness, max(head, _THINNEST)
        one.points = [as_point(one, start), as_point(one, start + vector)]
        out.append(one)
    return out


def ellipsoids(marker: Any, space: str, shapes: Sequence[tuple[Array, Array]], colour: Colour) -> list[Any]:
    """Ellipsoids of these poses (4, 4) and half axes (3,) [m]."""
    out = []
    for T, half in shapes:
        one = _shape(marker, marker.SPHERE, space, colour)
        fill_pose(one.pose, T)
        one.scale.x, one.scale.y, one.scale.z = (max(2.0 * float(h), _THINNEST) for h in half)
        out.append(one)
    return out


def dots(marker: Any, space: str, positions: Array, colour: Colour, diameter: float) -> list[Any]:
    """One marker with a ball at each position (N, 3) [m]; none where there are no positions."""
    if not len(positions):
        return []
    one = _shape(marker, marker.SPHERE_LIST, space, colour)
    one.scale.x = one.scale.y = one.scale.z = diameter
    one.points = [as_point(one, p) for p in positions]
    return [one]


def caption(marker: Any, space: str, position: Array, text: str, height: float) -> Any:
    """Lines of text that face whoever looks, with capital letters so high [m]."""
    one = _shape(marker, marker.TEXT_VIEW_FACING, space, (0.85, 0.85, 0.85, 1.0))
    one.pose.position = as_point(one, position)
    one.scale.z = height
    one.text = text
    return one


def _shape(marker: Any, kind: int, space: str, colour: Colour) -> Any:
    one = marker()
    one.ns, one.type, one.action = space, kind, marker.ADD
    one.pose.orientation.w = 1.0
    one.color.r, one.color.g, one.color.b, one.color.a = colour
    one.frame_locked = True
    return one
