"""Parameters of the nodes that learn an object and pull at it: default, bounds and what each means."""

from __future__ import annotations

from modcal_nodes.ros.parameter import Parameter

ARTICULATION_ESTIMATOR = {
    "input": Parameter(
        "joint_states", "Source of the handle's pose: joint_states, tool_pose, tracker/pose, tracker/point."
    ),
    "robot_description": Parameter("", "URDF text; empty: take it from the topic robot_description."),
    "base": Parameter("", "Link where the arm begins; empty: the root link."),
    "tip": Parameter("", "Link that holds the handle; empty: the link behind most published joints."),
    "rate_hz": Parameter(50.0, "Poses are taken at most this often [Hz].", 1.0, 250.0),
    "model_hz": Parameter(10.0, "The object's description is published at most this often [Hz].", 0.1, 100.0),
    "timeout_s": Parameter(0.5, "Age at which joint states are too old [s].", 0.01, 10.0),
    "tolerance_m": Parameter(4e-3, "Prediction error below which a model is trusted [m].", 1e-4, 0.05),
    "trust_after_m": Parameter(
        0.0, "Path that must be seen before a model is trusted [m]; 0: as soon as it has predicted.", 0.0, 10.0
    ),
    "lookahead_m": Parameter(0.05, "Distance of the expected pose ahead along the path [m].", 1e-3, 0.5),
    "still_m": Parameter(
        3e-3, "Motion of a pulled handle in one second below which it counts as stuck [m].", 1e-4, 0.05
    ),
    "pull_n": Parameter(15.0, "Force above the initial one that counts as a pull [N].", 0.5, 500.0),
    "tool_mass": Parameter(
        0.0,
        "Mass beyond the force sensor [kg]; needs upright poses and wrenches in the gripper frame; 0: none.",
        0.0,
        100.0,
    ),
}

IMPEDANCE_SETPOINT = {
    "robot_description": Parameter("", "URDF text; empty: take it from the topic robot_description."),
    "base": Parameter("", "Link where the arm begins; empty: the root link."),
    "tip": Parameter("", "Link that holds the handle; empty: the one behind most joints."),
    "calibrated": Parameter(False, "Whether the tool is where tool_pose (the corrector's ~/pose) says it is."),
    "autostart": Parameter(False, "Whether the node configures and activates itself."),
    "mode": Parameter("admittance", "admittance (for a stiff controller), or expected (for a compliant controller)."),
    "direction": Parameter([0.0, 0.0, -1.0], "Assumed direction of the pull, in the tool frame."),
    "goal": Parameter(0.0, "Opening to reach [rad when it turns, else m]; 0: goal_rad or goal_m.", 0.0, 3.0),
    "goal_rad": Parameter(1.0472, "Opening of objects that turn [rad].", 0.01, 3.0),
    "goal_m": Parameter(0.3, "Opening of objects that slide [m].", 0.005, 2.0),
    "exploration_speed_m_s": Parameter(0.03, "Speed of the pull while the path is unknown [m/s].", 0.001, 0.2),
    "speed_m_s": Parameter(0.06, "Speed once the path is known [m/s].", 0.001, 0.5),
    "max_exploration_m": Parameter(0.25, "Longest motion while the path is unknown [m].", 0.01, 1.0),
    "mass": Parameter([10.0, 10.0, 1.0], "Mass of the impedance along the pull, across, turning [kg; kg m2]."),
    "damping": Parameter([1000.0, 1000.0, 80.0], "Its damping, the same three [N s/m; N m s/rad]."),
    "stiffness": Parameter([1000.0, 300.0, 20.0], "Its stiffness, the same three [N/m; N m/rad]."),
    "stack_stiffness": Parameter(
        [3000.0, 200.0], "Stiffness requested from a stiff controller, translation and rotation [N/m; N m/rad]."
    ),
    "blend_s": Parameter(0.5, "Time over which new gains are blended in [s].", 0.0, 10.0),
    "slowdown_force_n": Parameter(
        0.0, "Force above which the speed is reduced [N]; 0: 60 % of max_force_n.", 0.0, 500.0
    ),
    "slowdown_moment_nm": Parameter(6.0, "The same for the moment [N m].", 0.01, 100.0),
    "stop_force_n": Parameter(0.0, "Force at which the speed is zero [N]; 0: 95 % of max_force_n.", 0.0, 500.0),
    "stop_moment_nm": Parameter(14.0, "The same for the moment [N m].", 0.02, 100.0),
    "max_force_n": Parameter(50.0, "Force at which the pull is aborted [N].", 1.0, 500.0),
    "max_moment_nm": Parameter(20.0, "The same for the moment [N m].", 0.1, 100.0),
    "max_speed_m_s": Parameter(0.25, "Largest speed of the tool's setpoint [m/s].", 0.001, 2.0),
    "max_acceleration_m_s2": Parameter(2.5, "Largest acceleration of the tool's setpoint [m/s2].", 0.01, 50.0),
    "max_angular_speed_rad_s": Parameter(1.5, "Largest angular speed of the tool's setpoint [rad/s].", 0.01, 10.0),
    "max_angular_acceleration_rad_s2": Parameter(
        15.0, "Largest angular acceleration of the tool's setpoint [rad/s2].", 0.1, 300.0
    ),
    "max_displacement_m": Parameter(0.1, "Largest distance of a setpoint from the measured tool [m].", 0.001, 1.0),
    "max_rotation_rad": Parameter(0.5, "Largest rotation of a setpoint from the measured tool [rad].", 0.01, 3.0),
    "joint_speed_rad_s": Parameter(1.5, "Largest speed of revolute joints [rad/s].", 0.001, 10.0),
    "joint_speed_m_s": Parameter(0.3, "Largest speed of prismatic joints [m/s].", 0.0001, 5.0),
    "joint_acceleration_rad_s2": Parameter(15.0, "Largest acceleration of revolute joints [rad/s2].", 0.01, 200.0),
    "joint_acceleration_m_s2": Parameter(3.0, "Largest acceleration of prismatic joints [m/s2].", 0.001, 100.0),
    "min_gain": Parameter(
        0.02, "Smallest singular value of the Jacobian; below it the posture counts as singular [m; rad].", 1e-4, 1.0
    ),
    "tool_mass": Parameter(0.0, "Mass beyond the force sensor, if known [kg]; 0: tare only.", 0.0, 100.0),
    "tool_centre": Parameter([0.0, 0.0, 0.0], "Centre of that mass in the sensor's frame [m]."),
    "gravity": Parameter([0.0, 0.0, -9.80665], "Gravity in the base link [m/s2]."),
    "wrench_frame": Parameter("", "Another link fixed to the tool in which wrenches may be given."),
    "wrench_by_tool": Parameter(False, "Whether the sensor reports the wrench exerted by the tool, not on the tool."),
    "cutoff_hz": Parameter(30.0, "Cutoff of the force's low-pass [Hz].", 0.5, 500.0),
    "servo_lag_s": Parameter(0.03, "Lag of the arm behind steadily moving setpoints [s].", 0.0, 1.0),
    "contact_stiffness_n_m": Parameter(
        15e3, "Assumed stiffness of arm, hand and object at a hard stop [N/m].", 100.0, 1e6
    ),
    "arm_stiffness_n_m": Parameter(
        100e3, "Stiffest that the servos hold the tool, by which a force that is not felt is judged [N/m].", 100.0, 1e7
    ),
    "max_joint_lead_rad": Parameter(
        0.04,
        "Of an arm with stiff joint servos: lead of a joint's reference under its full effort at most, by which a "
        "force that is not felt is judged [rad]; 0: not known, or compliant joints.",
        0.0,
        1.0,
    ),
    "tare_s": Parameter(0.5, "Duration of the tare [s].", 0.1, 10.0),
    "timeout_s": Parameter(0.1, "Age at which an input is too old [s].", 0.01, 2.0),
    "patience_s": Parameter(1.0, "Time that a pull waits for a late input before it is aborted [s].", 0.0, 60.0),
    "rate_hz": Parameter(250.0, "Rate of setpoints [Hz].", 10.0, 1000.0),
    "horizon_s": Parameter(0.02, "Time to reach a trajectory's point [s].", 0.001, 1.0),
}
