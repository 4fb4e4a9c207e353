"""Every parameter of every node: default, bounds and what it means. Needs no ROS."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from modcal_core.errors import BadTable
from modcal_core.files import parse_yaml
from modcal_core.planning import RETURNS


@dataclass(frozen=True)
class Parameter:
    """default: also gives the type. low, high: bounds of a number, both or neither.

    live: whether it may be changed while the node runs, and then takes effect; every other one is read-only.
    """

    default: Any
    description: str
    low: float | None = None
    high: float | None = None
    live: bool = False

    def parsed(self, where: str, written: str) -> Any:
        """The value that a text says, of the default's type and within the bounds. where: what stands before it.

        Raises BadTable.
        """
        kind = type(self.default)
        value: Any = written if kind is str else parse_yaml(written, where)
        try:
            if kind is list:
                value = [type(self.default[0])(item) for item in (value if isinstance(value, list) else [value])]
            elif (kind is bool and value in (0, 1)) or (kind is float and not isinstance(value, bool)):
                value = kind(value)
            fits = type(value) is kind and (kind in (str, bool) or bool(np.isfinite(value).all()))
        except (TypeError, ValueError):
            fits = False
        if not fits:
            said = {list: "is no list of numbers", bool: "is neither true nor false"}
            raise BadTable(f"{where}{written}", said.get(kind, f"is no {kind.__name__}"), "write one")
        if self.low is not None and self.high is not None and not self.low <= value <= self.high:
            raise BadTable(f"{where}{written}", f"{self.low:g} to {self.high:g} is allowed", "choose a value between")
        return value


def _live(default: Any, description: str, low: float | None = None, high: float | None = None) -> Parameter:
    """One that may be changed while the node runs; of the impedance_setpoint with its next pull, or its next
    configuration.
    """
    return Parameter(default, description, low, high, live=True)


_MANAGED = {"autostart": Parameter(True, "Whether the node configures and activates itself when it starts.")}

RECORDER = {
    **_MANAGED,
    "out": Parameter("", "Folder of the bag; must not exist. Empty: modcal_ and the time of day."),
    "topics": Parameter(
        ["joint_states", "robot_description", "tracker/pose", "tracker/point", "tracker/range", "tracker/bearing",
         "tracker/plane", "gripper/range", "joint_commands", "temperature", "wrench"],
        "Topics to record, relative to the node's namespace, each as soon as a publisher exists.",
    ),
    "optional": Parameter(
        ["tracker/pose", "tracker/point", "tracker/range", "tracker/bearing", "tracker/plane", "gripper/range",
         "joint_commands", "temperature", "wrench"],
        "Topics that may be missing without a warning.",
    ),
    "patience_s": _live(5.0, "Seconds without a message after which a warning is given.", 0.1, 3600.0),
    "min_free_mb": _live(200.0, "Free disk space below which the bag is closed and the node ends [MB].", 0.0, 1e12),
}  # fmt: skip

CALIBRATOR = {
    **_MANAGED,
    "robot_description": Parameter("", "URDF text; empty: take it from the topic robot_description."),
    "delta": Parameter("", "File of a nominal Delta robot, instead of a robot_description; empty: none."),
    "base": Parameter("", "Link where the arm begins; empty: the root link."),
    "tip": Parameter("", "Link where the arm ends; empty: the link behind most published joints."),
    "fixed": Parameter([""], "Parameters that are not fitted, by name, place or pattern."),
    "cell": Parameter("", "File of known distances and fixed parameters; empty: none."),
    "out": _live("", "Folder for the files of a solve; empty: none are written."),
    "state": Parameter("", "Folder where the trusted model and the stations survive restarts; empty: none."),
    "sentinel": Parameter("", "Folder of the history by which the arm at its work is watched; empty: it is not."),
    "sentinel_every_s": Parameter(3600.0, "Seconds from one piece (buffer_s) that is judged to the next.", 0.0, 1e6),
    "target": Parameter("", "File of a printed target whose corners are taken from the topic corners; empty: none."),
    "also_corners": Parameter([""], "Topics of corners of further cameras that see the same target; empty: none."),
    "effects": _live(True, "Whether a solve looks for effects beyond the geometry."),
    "seed": _live(0, "Seed of the split into train, explain and held-out.", 0, 2**31 - 1),
    "clock_limit_s": _live(0.5, "Largest offset between tracker and joint clocks that is corrected [s].", 0.0, 60.0),
    "accept": _live("better", "When a result is trusted: better (significantly, than the trusted one), or asked."),
    "first_solve": _live(0, "Stations after which the first solve starts by itself; 0: only on request.", 0, 100_000),
    "after_change": _live(20, "Stations after a change until the diagnosis is repeated; 0: on request.", 0, 100_000),
    "check_stations": Parameter(10, "Newest stations that ~/check looks at.", 5, 48),
    "process_noise_places": Parameter([""], "Places that may drift slowly: base, tool or joints; empty: none."),
    "process_noise_m": Parameter(1e-6, "Standard deviation of that drift over one second [m].", 0.0, 1e-2),
    "process_noise_rad": Parameter(1e-6, "Standard deviation of the rotation over one second [rad].", 0.0, 1e-2),
    "buffer_s": Parameter(300.0, "Seconds of raw messages kept; older ones are kept as stations.", 20.0, 3600.0),
    "max_stations": _live(2000, "Stations kept; beyond that, older ones are thinned.", 50, 100_000),
    "silence_timeout_s": _live(5.0, "Seconds without a message after which a topic counts as silent.", 0.1, 600.0),
    "publish_tf": Parameter(False, "Whether the trusted model's trackers and tool are on /tf_static (tf2_msgs)."),
}

BOARD_DETECTOR = {
    "target": Parameter("", "File of the printed target, as modcal target writes it, or Kalibr's."),
    "rate_hz": Parameter(5.0, "Images that are looked at, at most [Hz]; the others are passed over.", 0.1, 60.0),
}

CORRECTOR = {
    **_MANAGED,
    "calibration": Parameter("", "Folder or file of a calibration; empty: take it from the latched topic calibration."),
    "robot_description": Parameter("", "URDF text; empty: take it from the topic robot_description."),
    "delta": Parameter("", "File of a nominal Delta robot, instead of a robot_description; empty: none."),
    "target": _live("tip", "Frame of the poses: tip (the tip link) or tool (the tracked target)."),
    "stream": _live(False, "Whether every desired pose is a setpoint to be reached within horizon_s."),
    "horizon_s": _live(0.1, "Time to reach a setpoint of a stream [s].", 0.005, 2.0),
    "timeout_s": _live(0.1, "Age at which joint states and poses of a stream are too old [s].", 0.01, 2.0),
    "goal_timeout_s": _live(1.0, "The same for desired poses outside a stream [s].", 0.01, 60.0),
    "joint_speed_rad_s": _live(0.5, "Largest speed of revolute joints [rad/s].", 0.001, 10.0),
    "joint_speed_m_s": _live(0.1, "Largest speed of prismatic joints [m/s].", 0.0001, 5.0),
    "tolerance_m": _live(1e-6, "Predicted position error above which a pose is refused [m].", 1e-9, 1e-3),
    "tolerance_rad": _live(1e-6, "The same for orientation [rad].", 1e-9, 1e-2),
    "switch_step_rad": _live(2e-3, "Largest joint step of a stream by a new calibration [rad; m].", 0.0, 0.1),
    "blend_s": _live(1.0, "Time over which such a step is blended in [s].", 0.0, 60.0),
    "rate_hz": _live(100.0, "Corrected poses and joint states are published at most this often [Hz].", 0.1, 1000.0),
    "publish_tf": Parameter(False, "Whether the corrected tip is published on /tf, as TIP_corrected (tf2_msgs)."),
}

SIMULATED_CELL = {
    "urdf": Parameter("", "URDF file of the nominal arm."),
    "delta": Parameter("", "File of a nominal Delta robot, instead of a URDF; empty: none."),
    "base": Parameter("", "Link where the arm begins; empty: the root link."),
    "tip": Parameter("", "Link where the arm ends; empty: the one behind most joints."),
    "seed": Parameter(1, "Seed of the true arm, the tracker's place, tool, program and noise.", 0, 2**31 - 1),
    "visit": Parameter(0, "Second seed: same arm, tracker and tool, other postures and noise.", 0, 2**31 - 1),
    "length_std_m": Parameter(5e-4, "Displacement of the true arm's bodies, deviation per axis [m].", 0.0, 0.1),
    "angle_std_rad": Parameter(1e-3, "Rotation of the true arm's bodies, deviation per axis [rad].", 0.0, 0.2),
    "noise_m": Parameter(2e-5, "Noise of one tracker reading, per axis [m].", 0.0, 0.1),
    "noise_rad": Parameter(5e-5, "Noise of one tracker orientation, per axis [rad].", 0.0, 0.1),
    "repeatability_rad": Parameter(0.0, "Repeatability of each joint at each arrival [rad; m].", 0.0, 0.01),
    "gear_joint": Parameter("", "Joint with a gear error that the model does not contain; empty: none."),
    "gear_cycles": Parameter(101.0, "Periods of that error per turn of the joint.", 0.0, 1000.0),
    "gear_amplitude_rad": Parameter(2e-4, "Amplitude of that error [rad].", 0.0, 0.01),
    "joint_compliance_rad_per_nm": Parameter([0.0], "Compliance of all joints, or of each [rad/(N m); m/N]."),
    "measurement": Parameter("pose", "Readings of the tracker: pose or point."),
    "joint_rate_hz": Parameter(125.0, "Rate of joint states [Hz].", 1.0, 2000.0),
    "tracker_rate_hz": Parameter(50.0, "Rate of tracker readings [Hz].", 1.0, 2000.0),
    "publish_effort": Parameter(False, "Whether joint states contain the holding torques as effort."),
    "start_delay_s": Parameter(0.0, "Delay before the first message, for discovery of subscribers [s].", 0.0, 60.0),
    "min_subscribers": Parameter(0, "Subscribers of joint states and of readings to wait for before it.", 0, 100),
    "stations": Parameter(0, "Random postures to visit without commands; 0: wait for joint_trajectory.", 0, 100_000),
    "returns": Parameter(RETURNS, "Number of these visited twice, so that the noise floor is known; 0: none.", 0, 1000),
    "dwell_s": Parameter(0.8, "Standstill at each random posture [s].", 0.0, 60.0),
    "travel_s": Parameter(0.5, "Travel time to each random posture [s].", 0.05, 60.0),
    "obey_limits": Parameter(False, "Whether travel keeps to the URDF's limits; modcal simulate always does."),
    "repeat": Parameter(False, "Whether to continue with new random postures indefinitely."),
    "publish_clock": Parameter(False, "Whether to publish a simulated time on /clock and to stamp with it."),
    "clock_rate_hz": Parameter(250.0, "Rate of /clock in simulated time [Hz].", 1.0, 2000.0),
    "time_factor": Parameter(1.0, "Simulated seconds per real second.", 0.01, 100.0),
    "clock_start_s": Parameter(1000.0, "Start of simulated time [s].", 0.0, 4e9),
    "temperature_noise_k": Parameter(0.05, "Noise of a temperature [K].", 0.0, 10.0),
    # from here on: may be changed while the cell runs
    "payload_kg": _live(0.0, "Undeclared mass at the tip [kg].", 0.0, 100.0),
    "tool_bump_m": _live([0.0, 0.0, 0.0], "Displacement of the tool, along its axes [m]."),
    "tool_turn_rad": _live([0.0, 0.0, 0.0], "Rotation of the tool, as a rotation vector [rad]."),
    "tracker_move_m": _live([0.0, 0.0, 0.0], "Displacement of the tracker, along its axes [m]."),
    "warm_up_link": _live("", "Link that warms up, and whose temperature is published; empty: none."),
    "warm_up_m": _live(0.0, "Final growth of that link [m].", -0.01, 0.01),
    "warm_up_s": _live(60.0, "Time constant of its warming and cooling [s].", 0.1, 1e5),
}

SIMULATED_FURNITURE = {
    "urdf": Parameter("", "URDF file of the arm; its links must have masses."),
    "base": Parameter("", "Link where the arm begins; empty: the root link."),
    "tip": Parameter("", "Link that holds the handle; empty: the one behind most joints."),
    "seed": Parameter(0, "Seed of the object, its place, the tool's weight and the noise.", 0, 2**31 - 1),
    "kind": Parameter("", "Object to pull: door, drawer, screw or folding; empty: a random door or drawer."),
    "grasp": Parameter("", "Grasp of the handle: weld (rigid) or ball (free to turn); empty: random."),
    "radius_m": Parameter(-1.0, "Distance of the handle from the hinge [m]; below zero: random.", -1.0, 2.0),
    "friction": Parameter(-1.0, "Dry friction of its joint [N m; N]; below zero: random.", -1.0, 200.0),
    "damping": Parameter(-1.0, "Damping of its joint [N m s/rad; N s/m]; below zero: random.", -1.0, 1000.0),
    "spring": Parameter(-1.0, "Stiffness that closes it [N m/rad; N/m]; below zero: random.", -1.0, 1000.0),
    "mass_kg": Parameter(-1.0, "Mass of what moves [kg]; below zero: random.", -1.0, 200.0),
    "stop": Parameter(-1.0, "Position at which it jams [rad; m]; 0: locked; below zero: at its own end.", -1.0, 3.0),
    "resistance": Parameter(
        "",
        "What holds it back besides, and its force at the handle [N]: closer, magnet, gasket, stick_slip, detents, "
        "over_centre or soft_end, as in 'closer 25'; empty: nothing.",
    ),
    "servo_stiffness": Parameter(4000.0, "Stiffness of the joints' servos [N m/rad].", 100.0, 1e5),
    "servo_lag_s": Parameter(0.03, "Lag behind a steadily moving reference [s].", 0.005, 0.2),
    "joint_rate_hz": Parameter(250.0, "Rate of joint states [Hz].", 10.0, 1000.0),
    "wrench_rate_hz": Parameter(250.0, "Rate of the wrist's sensor [Hz].", 10.0, 1000.0),
    "truth_rate_hz": Parameter(100.0, "Rate of ~/contact_force and ~/object_truth [Hz].", 1.0, 1000.0),
    "publish_clock": Parameter(False, "Whether to publish simulated time on /clock; it slows down on a busy machine."),
    "clock_rate_hz": Parameter(500.0, "Rate of /clock in simulated time [Hz].", 10.0, 2000.0),
    "keep_step": Parameter(False, "Whether simulated time also waits for the next reference while references arrive."),
    "time_factor": Parameter(1.0, "Simulated seconds per real second.", 0.01, 10.0),
    "noise_n": Parameter(0.2, "Noise of a force, per axis [N].", 0.0, 10.0),
    "noise_nm": Parameter(0.01, "Noise of a torque, per axis [N m].", 0.0, 1.0),
    "publish_effort": Parameter(False, "Whether joint states contain what the drives give as effort."),
    "approach_s": Parameter(0.0, "Time in which the hand comes to the handle first [s]; 0: none.", 0.0, 60.0),
}


ACCELERATION_LIMITS = {
    **_MANAGED,
    "robot_description": Parameter("", "URDF text; empty: take it from the topic robot_description."),
    "base": Parameter("", "Link where the arm begins; empty: the root link."),
    "tip": Parameter("", "Link that carries the payload; empty: the link behind most published joints."),
    "payload_kg": _live(0.0, "Mass that the arm carries [kg].", 0.0, 1e4),
    "payload_centre_m": _live([0.0, 0.0, 0.0], "Its centre of mass in the tip link [m]."),
    "payload_inertia": _live([0.0] * 6, "Inertia about the centre of mass: ixx iyy izz ixy ixz iyz [kg m2]."),
    "method": _live("coupled", "coupled (bounds for all joints at once), or equivalent (each joint by itself)."),
    "torque_share": _live(1.0, "Share of every drive's torque that may be used.", 0.01, 1.0),
    "torque": _live([""], "Largest torques, instead of the URDF's effort, as joint=value [N m; N]."),
    "friction": _live([""], "Dry friction, instead of the URDF's, as joint=value [N m; N]."),
    "damping": _live([""], "Viscous friction, instead of the URDF's, as joint=value [N m s/rad; N s/m]."),
    "rotor": _live([""], "Inertia of motor and gear, seen from the joint, as joint=value [kg m2; kg]."),
    "gravity": _live([0.0, 0.0, -9.80665], "Gravity in the base link [m/s2]."),
    "timeout_s": _live(0.1, "Age at which joint states are too old [s].", 0.01, 10.0),
    "rate_hz": Parameter(50.0, "Bounds are published at most this often [Hz].", 0.1, 250.0),
}

VIEWER = {
    "robot_description": Parameter("", "URDF text; empty: take it from the topic robot_description."),
    "base": Parameter("", "Link where the arm begins; empty: that of the calibration, else the root link."),
    "tip": Parameter("", "Link where the arm ends; empty: the calibration's, else that behind most joints."),
    "arrow_scale": _live(100.0, "Magnification of errors: at 100, 1 mm is drawn as 10 cm.", 1.0, 1e5),
    "full_colour_m": _live(1e-3, "Residual from which an arrow is red [m].", 1e-6, 1.0),
    "stations": Parameter(60, "Number of latest stations shown.", 1, 1000),
    "timeout_s": _live(0.5, "Age at which joint states are too old to show a posture [s].", 0.01, 10.0),
    "rate_hz": Parameter(5.0, "Rate at which markers are redrawn [Hz].", 0.1, 30.0),
}


DOOR_DEMO = {
    "start": Parameter(True, "Whether the node starts the other nodes; false: a launch file does."),
    "kind": Parameter("door", "Object to open: door or drawer."),
    "seed": Parameter(0, "Seed of the object, its place and the noise.", 0, 2**31 - 1),
    "patience_s": Parameter(90.0, "Time after which the demo is aborted [s].", 5.0, 3600.0),
    "out": Parameter("", "Folder of the page about what was learned of the object; empty: none is written."),
}

TRAJECTORY_SENDER = {
    "trajectory": Parameter("", "File of the trajectory, as modcal plan writes it (trajectory.yaml)."),
    "speed_rad_s": Parameter(0.2, "Speed of the approach to the first point [rad/s; m/s].", 0.001, 3.0),
    "approach_rad": Parameter(0.1, "Largest joint distance to the first point [rad; m].", 0.0, 10.0),
    "tolerance_rad": Parameter(0.01, "Tolerance at the last point [rad; m].", 1e-5, 0.5),
    "timeout_s": Parameter(0.5, "Age at which joint states are too old [s].", 0.01, 10.0),
    "patience_s": Parameter(10.0, "Time to wait for inputs, and for the arm to arrive [s].", 0.1, 3600.0),
}

STATION_RUNNER = {
    **_MANAGED,
    "out": Parameter("", "Folder of the session and its results; a session that is there goes on."),
    "robot_description": Parameter("", "URDF to use in place of the topic robot_description."),
    "base": Parameter("", "First link of the arm; empty: the root."),
    "tip": Parameter("", "Last link of the arm; empty: the one behind most joints."),
    "meshes": Parameter("", "Folder in which the mesh files of collision shapes are."),
    "site": Parameter("", "YAML of tracker, target, obstacles, limits and workspace, as modcal plan takes."),
    "goal_mm": Parameter(0.0, "Error at the tool to be proven [mm]; 0: as good as can be.", 0.0, 1000.0),
    "statistic": Parameter("rms", "Statistic of goal_mm: rms or p95."),
    "stations": Parameter(400, "Most stations.", 1, 100000),
    "minutes": Parameter(0.0, "Most time [min]; 0: no limit.", 0.0, 100000.0),
    "measurement": Parameter("pose", "What the instrument sends: pose (tracker/pose) or point (tracker/point)."),
    "geometry_only": Parameter(False, "Fit only the geometry; look for no effects."),
    "seed": Parameter(0, "Seed of what is drawn at random.", 0, 2147483647),
    "yes": _live(False, "Accept the dry run: begin to move once it is made, without ~/start."),
    "no_self_collision": Parameter(False, "Accept a description without collision shapes: only spheres are checked."),
    "speed_rad_s": _live(0.3, "Largest speed of a joint [rad/s; m/s].", 0.001, 3.0),
    "settle_s": _live(0.5, "Standstill before a station is read [s].", 0.05, 60.0),
    "readings": _live(10, "Readings averaged at a station.", 1, 10000),
    "patience_s": _live(5.0, "Time for arrival and for readings until a station is not seen [s].", 0.1, 600.0),
    "timeout_s": _live(0.2, "Age at which joint states are too old, and the arm is held [s].", 0.01, 10.0),
    "tracking_rad": _live(0.1, "Distance from the commanded motion at which the arm is held [rad; m].", 1e-4, 1.0),
    "tolerance_rad": _live(0.01, "Distance from a station that counts as arrived [rad; m].", 1e-5, 0.5),
    "rate_hz": Parameter(50.0, "Rate of the checks; a hold is sent within one period [Hz].", 5.0, 500.0),
}

ARTICULATION_ESTIMATOR = {
    **_MANAGED,
    "input": Parameter("joint_states", "Handle's pose from joint_states, tool_pose, tracker/pose or tracker/point."),
    "robot_description": Parameter("", "URDF text; empty: take it from the topic robot_description."),
    "base": Parameter("", "Link where the arm begins; empty: the root link."),
    "tip": Parameter("", "Link that holds the handle; empty: the link behind most published joints."),
    "rate_hz": _live(50.0, "Poses are taken at most this often [Hz].", 1.0, 250.0),
    "model_hz": _live(10.0, "The object's description is published at most this often [Hz].", 0.1, 100.0),
    "timeout_s": _live(0.5, "Age at which joint states are too old [s].", 0.01, 10.0),
    "tolerance_m": Parameter(4e-3, "Prediction error below which a model is trusted [m].", 1e-4, 0.05),
    "trust_after_m": Parameter(0.0, "Path seen before a model is trusted [m]; 0: once it has predicted.", 0.0, 10.0),
    "lookahead_m": _live(0.05, "Distance of the expected pose ahead along the path [m].", 1e-3, 0.5),
    "still_m": Parameter(3e-3, "Motion of a pulled handle in a second below which it is stuck [m].", 1e-4, 0.05),
    "pull_n": _live(15.0, "Force above the initial one that counts as a pull [N].", 0.5, 500.0),
    "tool_mass": Parameter(
        0.0,
        "Mass beyond the force sensor [kg]; needs upright poses and wrenches in the gripper frame; 0: none.",
        0.0,
        100.0,
    ),
}

IMPEDANCE_SETPOINT = {
    "robot_description": Parameter("", "URDF text; empty: take it from the topic robot_description."),
    "base": _live("", "Link where the arm begins; empty: the root link."),
    "tip": _live("", "Link that holds the handle; empty: the one behind most joints."),
    "calibrated": _live(False, "Whether the tool is where tool_pose (the corrector's ~/pose) says it is."),
    "autostart": Parameter(False, "Whether the node configures and activates itself."),
    "mode": _live("admittance", "admittance (for a stiff controller), or expected (for a compliant controller)."),
    "direction": _live([0.0, 0.0, -1.0], "Assumed direction of the pull, in the tool frame."),
    "goal": _live(0.0, "Opening to reach [rad when it turns, else m]; 0: goal_rad or goal_m.", 0.0, 3.0),
    "goal_rad": _live(1.0472, "Opening of objects that turn [rad].", 0.01, 3.0),
    "goal_m": _live(0.3, "Opening of objects that slide [m].", 0.005, 2.0),
    "exploration_speed_m_s": _live(0.03, "Speed of the pull while the path is unknown [m/s].", 0.001, 0.2),
    "speed_m_s": _live(0.06, "Speed once the path is known [m/s].", 0.001, 0.5),
    "max_exploration_m": _live(0.25, "Longest motion while the path is unknown [m].", 0.01, 1.0),
    "mass": _live([10.0, 10.0, 1.0], "Mass of the impedance along the pull, across, turning [kg; kg m2]."),
    "damping": _live([1000.0, 1000.0, 80.0], "Its damping, the same three [N s/m; N m s/rad]."),
    "stiffness": _live([1000.0, 300.0, 20.0], "Its stiffness, the same three [N/m; N m/rad]."),
    "stack_stiffness": _live([3000.0, 200.0], "Stiffness asked of a stiff controller [N/m; N m/rad]."),
    "blend_s": _live(0.5, "Time over which new gains are blended in [s].", 0.0, 10.0),
    "slowdown_force_n": _live(0.0, "Force above which the speed is reduced [N]; 0: 60 % of max_force_n.", 0.0, 500.0),
    "slowdown_moment_nm": _live(6.0, "The same for the moment [N m].", 0.01, 100.0),
    "stop_force_n": _live(0.0, "Force at which the speed is zero [N]; 0: 95 % of max_force_n.", 0.0, 500.0),
    "stop_moment_nm": _live(14.0, "The same for the moment [N m].", 0.02, 100.0),
    "max_force_n": _live(50.0, "Force at which the pull is aborted [N].", 1.0, 500.0),
    "max_moment_nm": _live(20.0, "The same for the moment [N m].", 0.1, 100.0),
    "max_speed_m_s": _live(0.25, "Largest speed of the tool's setpoint [m/s].", 0.001, 2.0),
    "max_acceleration_m_s2": _live(2.5, "Largest acceleration of the tool's setpoint [m/s2].", 0.01, 50.0),
    "max_angular_speed_rad_s": _live(1.5, "Largest angular speed of the tool's setpoint [rad/s].", 0.01, 10.0),
    "max_angular_acceleration_rad_s2": _live(15.0, "Its largest angular acceleration [rad/s2].", 0.1, 300.0),
    "max_displacement_m": _live(0.1, "Largest distance of a setpoint from the measured tool [m].", 0.001, 1.0),
    "max_rotation_rad": _live(0.5, "Largest rotation of a setpoint from the measured tool [rad].", 0.01, 3.0),
    "joint_speed_rad_s": _live(1.5, "Largest speed of revolute joints [rad/s].", 0.001, 10.0),
    "joint_speed_m_s": _live(0.3, "Largest speed of prismatic joints [m/s].", 0.0001, 5.0),
    "joint_acceleration_rad_s2": _live(15.0, "Largest acceleration of revolute joints [rad/s2].", 0.01, 200.0),
    "joint_acceleration_m_s2": _live(3.0, "Largest acceleration of prismatic joints [m/s2].", 0.001, 100.0),
    "min_gain": _live(0.02, "Singular value of the Jacobian below which a posture is singular [m; rad].", 1e-4, 1.0),
    "tool_mass": _live(0.0, "Mass beyond the force sensor, if known [kg]; 0: tare only.", 0.0, 100.0),
    "tool_centre": _live([0.0, 0.0, 0.0], "Centre of that mass in the sensor's frame [m]."),
    "gravity": _live([0.0, 0.0, -9.80665], "Gravity in the base link [m/s2]."),
    "wrench": _live("sensor", "What tells the force on the tool: sensor (at the wrist), or efforts (of the joints)."),
    "wrench_frame": _live("", "Another link fixed to the tool in which wrenches may be given."),
    "wrench_by_tool": _live(False, "Whether the sensor reports the wrench exerted by the tool, not on the tool."),
    "cutoff_hz": _live(30.0, "Cutoff of the force's low-pass [Hz].", 0.5, 500.0),
    "servo_lag_s": _live(0.03, "Lag of the arm behind steadily moving setpoints [s].", 0.0, 1.0),
    "contact_stiffness_n_m": _live(20e3, "Stiffness of fingers and object; steel if felt stiffer [N/m].", 100.0, 1e6),
    "arm_stiffness_n_m": _live(100e3, "Stiffest hold of the servos, to judge a force not felt [N/m].", 100.0, 1e7),
    "max_joint_lead_rad": _live(
        0.04,
        "Of an arm with stiff joint servos: lead of a joint's reference under its full effort at most, by which a "
        "force that is not felt is judged [rad]; 0: not known, or compliant joints.",
        0.0,
        1.0,
    ),
    "tare_s": _live(0.5, "Duration of the tare [s].", 0.1, 10.0),
    "timeout_s": _live(0.1, "Age at which an input is too old [s].", 0.01, 2.0),
    "patience_s": _live(1.0, "Time that a pull waits for a late input before it is aborted [s].", 0.0, 60.0),
    "rate_hz": _live(250.0, "Rate of setpoints [Hz].", 10.0, 1000.0),
    "horizon_s": _live(0.02, "Time to reach a trajectory's point [s].", 0.001, 1.0),
}

NODES = {
    "board_detector": BOARD_DETECTOR,
    "recorder": RECORDER,
    "calibrator": CALIBRATOR,
    "corrector": CORRECTOR,
    "articulation_estimator": ARTICULATION_ESTIMATOR,
    "impedance_setpoint": IMPEDANCE_SETPOINT,
    "acceleration_limits": ACCELERATION_LIMITS,
    "viewer": VIEWER,
    "simulated_cell": SIMULATED_CELL,
    "simulated_furniture": SIMULATED_FURNITURE,
    "door_demo": DOOR_DEMO,
    "trajectory_sender": TRAJECTORY_SENDER,
    "station_runner": STATION_RUNNER,
}
