"""ROS messages to and from modcal's own arrays: in bags and on the wire, by the same functions. No nodes."""

# ruff: noqa: I001

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_msgs_py.bag import Bag, read_bag
    from modcal_msgs_py.bag_files import SUFFIXES, qos_profile
    from modcal_msgs_py.bag_open import PackedMessage
    from modcal_msgs_py.commands import Colour, JointInput, ObjectInput, arrows, caption, colour_of, desired_pose, dots
    from modcal_msgs_py.commands import ellipsoids, fill_accelerations, fill_joints, fill_markers, fill_object_state
    from modcal_msgs_py.commands import fill_picture, fill_point, fill_pose, fill_posed, fill_wrench, require_new
    from modcal_msgs_py.commands import require_version, seen, status_values, wrench_numbers
    from modcal_msgs_py.images import CLOUD, TAGS, RawImage, chosen_topic, corner_topics, fill_corners, image_topics
    from modcal_msgs_py.images import info_topic, lens_data, raw_image, read_corners, read_messages, size_of, stamp_of
    from modcal_msgs_py.images import stamps_of, tag_topics
    from modcal_msgs_py.layout import OneMessage, jazzy, learn
    from modcal_msgs_py.mcap_read import list_topics, read_recording
    from modcal_msgs_py.mcap_repair import Repair, repair_bag
    from modcal_msgs_py.mcap_write import FLUSH_SECONDS, BagWriter
    from modcal_msgs_py.messages import RecordingBuilder, why_left_out
    from modcal_msgs_py.playing import OfferedTopic, fill_message, message_data, messages_in_order, offered_topics
    from modcal_msgs_py.readings import SignalsHeard, nanoseconds, reading_of, seconds, set_nanoseconds, set_seconds
    from modcal_msgs_py.recording_write import episodes_of, is_lerobot, write_recording
    from modcal_msgs_py.topics import JOINT_COMMANDS, JOINT_STATES, READINGS, TYPES, AddedTopic, Joints, Signal, Topics
    from modcal_msgs_py.topics import accepted, role_of
    from modcal_msgs_py.track_rows import Commands
    from modcal_msgs_py.typed import asked_of_box, calibration_data, fill_calibration, fill_change, fill_checked
    from modcal_msgs_py.typed import fill_estimate, fill_held_box, fill_identity, fill_object_status, fill_verdict
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)
