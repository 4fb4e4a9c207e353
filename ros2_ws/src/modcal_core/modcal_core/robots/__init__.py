"""Robots: the serial chain, and the formats it is read from and written to."""

# ruff: noqa: I001

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_core.robots.acceleration import Drives, LoadedArm, Window, bias_torque, read_drives, require_method
    from modcal_core.robots.acceleration import torque
    from modcal_core.robots.bodies import DOWN, STANDARD_GRAVITY, HeldWeight, Payload, Stands, Weighed
    from modcal_core.robots.bodies import chain_gravity_wrench, equivalent_inertia, gravity_columns, gravity_efforts
    from modcal_core.robots.bodies import mass_matrix, weigh, with_payload
    from modcal_core.robots.chain import Chain, Follower, JointColumns, ranges, rotation_to_axis
    from modcal_core.robots.delta import ARMS, AZIMUTH, CONSTANTS, DISTAL, LEAN, OFFSET, PARAMETERS, PROXIMAL, RATIO
    from modcal_core.robots.delta import ZERO, Delta, delta_from_data, delta_to_data
    from modcal_core.robots.delta_kinematics import delta_inverse, position_jacobians, reachable, tool_pose
    from modcal_core.robots.delta_kinematics import tool_positions
    from modcal_core.robots.dh import from_dh, plain, read_rows, to_dh, vector
    from modcal_core.robots.fastest_motion import JointPath, constant_bounds, motion, within_bounds, within_torque
    from modcal_core.robots.kinematics import Frames, body_jacobian, chain_forward, frames, pose_and_jacobian
    from modcal_core.robots.kinematics import spatial_jacobian
    from modcal_core.robots.makers import NO_HASH, from_ur_kinematics, kinematics_yaml_data, lacks_hash
    from modcal_core.robots.mechanism import Mechanism, forward, gravity_wrench, inverse, inverse_batch
    from modcal_core.robots.mechanism import is_delta, is_serial_arm, joint_ranges, offset_wrench, passable
    from modcal_core.robots.mechanism import payload_wrench, random_postures, takes, tool_frames
    from modcal_core.robots.tables import CONVENTIONS, UNITS, NearestTable, from_cpc, from_csv, from_table, from_ur_conf
    from modcal_core.robots.tables import loss, nearest_dh, to_cpc, to_csv, to_table
    from modcal_core.robots.urdf import joint_origins, other_tips, read_chain, read_path
    from modcal_core.robots.urdf_inertias import CarryingJoint, Hanging, HeldBehind, Inertias, held_behind
    from modcal_core.robots.urdf_inertias import moved_centres, read_inertias, weightless
    from modcal_core.robots.urdf_tree import CollisionShape, Tree, collision_shapes, parse
    from modcal_core.robots.urdf_write import added, calibrated_urdf, chain_urdf, joint_element, number
    from modcal_core.robots.urdf_write import origin_element, rerooted, ros2_control_offsets, urdf_text, xacro_origins
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)
