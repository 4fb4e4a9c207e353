"""Robots: the serial chain, and the formats it is read from and written to."""

# ruff: noqa: I001

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_core.robots.acceleration import Drives, Window, bias_torque, read_drives, torque
    from modcal_core.robots.bodies import DOWN, STANDARD_GRAVITY, HeldWeight, Payload, chain_gravity_wrench
    from modcal_core.robots.bodies import equivalent_inertia, mass_matrix, with_payload
    from modcal_core.robots.chain import Chain, Follower, JointColumns, rotation_to_axis
    from modcal_core.robots.delta import ARMS, AZIMUTH, CONSTANTS, DISTAL, LEAN, OFFSET, PARAMETERS, PROXIMAL
    from modcal_core.robots.delta import RATIO, ZERO, Delta, delta_from_data, delta_to_data
    from modcal_core.robots.delta_kinematics import delta_inverse, position_jacobians, reachable, tool_pose
    from modcal_core.robots.delta_kinematics import tool_positions
    from modcal_core.robots.dh import from_dh, plain, read_rows, to_dh, vector
    from modcal_core.robots.fastest_motion import JointPath, constant_bounds, motion, within_bounds, within_torque
    from modcal_core.robots.mechanism import inverse, inverse_batch
    from modcal_core.robots.kinematics import Frames, body_jacobian, chain_forward, frames
    from modcal_core.robots.kinematics import pose_and_jacobian, spatial_jacobian
    from modcal_core.robots.acceleration import LoadedArm, require_method
    from modcal_core.robots.makers import NO_HASH, from_ur_kinematics, kinematics_yaml_data, lacks_hash
    from modcal_core.robots.mechanism import Mechanism, followers_of, forward, gravity_wrench, is_delta, is_serial_arm
    from modcal_core.robots.mechanism import joint_ranges, offset_wrench, passable, payload_wrench, random_postures
    from modcal_core.robots.mechanism import takes, tool_frames
    from modcal_core.robots.tables import CONVENTIONS, UNITS, NearestTable, from_cpc, from_csv, from_table, from_ur_conf
    from modcal_core.robots.tables import loss, nearest_dh, to_cpc, to_csv, to_table
    from modcal_core.robots.urdf import joint_origins, other_tips, read_chain, read_path
    from modcal_core.robots.urdf import CarryingJoint, Hanging, HeldBehind, Inertias, held_behind
    from modcal_core.robots.urdf import moved_centres, read_inertias, weightless
    from modcal_core.robots.urdf_tree import CollisionShape, Tree, collision_shapes, parse, rerooted
    from modcal_core.robots.urdf_write import calibrated_urdf, chain_urdf, joint_element
    from modcal_core.robots.urdf_write import number, origin_element, ros2_control_offsets, urdf_text, xacro_origins
    from modcal_core.robots.bodies import Stands, Weighed, gravity_columns, gravity_efforts, weigh
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)

__all__ = ["ARMS", "AZIMUTH", "CONSTANTS", "CONVENTIONS", "DISTAL", "DOWN", "LEAN", "NO_HASH", "OFFSET"]
__all__ += ["PARAMETERS", "PROXIMAL", "RATIO", "STANDARD_GRAVITY", "UNITS", "ZERO", "CarryingJoint", "Chain"]
__all__ += ["CollisionShape", "Delta", "Drives", "Follower", "Frames", "Hanging", "HeldBehind", "HeldWeight"]
__all__ += ["Inertias", "JointColumns", "JointPath", "LoadedArm", "Mechanism", "NearestTable", "Payload", "Stands"]
__all__ += ["Tree", "Weighed", "Window", "bias_torque", "body_jacobian", "calibrated_urdf", "chain_forward"]
__all__ += ["chain_gravity_wrench", "chain_urdf", "collision_shapes", "constant_bounds", "delta_from_data"]
__all__ += ["delta_inverse", "delta_to_data", "equivalent_inertia", "followers_of", "forward", "frames", "from_cpc"]
__all__ += ["from_csv", "from_dh", "from_table", "from_ur_conf", "from_ur_kinematics", "gravity_wrench", "held_behind"]
__all__ += ["gravity_columns", "gravity_efforts"]
__all__ += ["inverse", "inverse_batch", "is_delta", "is_serial_arm", "joint_element", "joint_origins", "joint_ranges"]
__all__ += ["kinematics_yaml_data", "lacks_hash", "loss", "mass_matrix", "motion", "moved_centres", "nearest_dh"]
__all__ += ["number", "offset_wrench", "origin_element", "other_tips", "parse", "passable", "payload_wrench", "plain"]
__all__ += ["pose_and_jacobian", "position_jacobians", "random_postures", "reachable", "read_chain", "read_drives"]
__all__ += ["read_inertias", "read_path", "read_rows", "require_method", "rerooted", "ros2_control_offsets"]
__all__ += ["rotation_to_axis", "spatial_jacobian", "takes", "to_cpc", "to_csv", "to_dh", "to_table", "tool_frames"]
__all__ += ["tool_pose", "tool_positions", "torque", "urdf_text", "vector", "weigh", "weightless", "with_payload"]
__all__ += ["within_bounds", "within_torque", "xacro_origins"]
