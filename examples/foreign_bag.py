"""A bag as other people's drivers publish it, from one of ``modcal simulate``: something to read for how-to pages.

    modcal simulate examples/robots/ur10.urdf --out plain -p stations=40
    python examples/foreign_bag.py plain vrpn --as vrpn      # poses on /vrpn_mocap/tool/pose, as vrpn_mocap does
    python examples/foreign_bag.py plain frames --as tf      # poses in /tf, world → tool_marker
    python examples/foreign_bag.py plain camera --as tag     # poses of a tag in /tf, seen by a camera on the hand

Joint states and the robot description are copied. The camera's poses get their own noise, more along the line of sight.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

POSES, TRANSFORMS = "geometry_msgs/msg/PoseStamped", "tf2_msgs/msg/TFMessage"
CAMERA, TAG = "camera_color_optical_frame", "tag36h11:0"
LATERAL, DEPTH, TURN = 1e-4, 5e-4, 1e-3  # m, m, rad; of one detection
TYPES = get_typestore(Stores.ROS2_JAZZY)


def matrix(pose: Any) -> np.ndarray:
    """(4, 4) of a geometry_msgs/Pose."""
    p, q = pose.position, pose.orientation
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), [p.x, p.y, p.z]
    return T


def transforms(header: Any, parent: str, child: str, T: np.ndarray) -> Any:
    """A message for /tf with one transform."""
    named = TYPES.types["std_msgs/msg/Header"](header.stamp, parent)
    moved = TYPES.types["geometry_msgs/msg/Vector3"](*map(float, T[:3, 3]))
    turned = TYPES.types["geometry_msgs/msg/Quaternion"](*map(float, Rotation.from_matrix(T[:3, :3]).as_quat()))
    transform = TYPES.types["geometry_msgs/msg/Transform"](moved, turned)
    return TYPES.types[TRANSFORMS]([TYPES.types["geometry_msgs/msg/TransformStamped"](named, child, transform)])


def seen_by_camera(T_tracker_tool: np.ndarray, T_tracker_tag: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Where a camera in place of the tool sees the tag, (4, 4), with noise."""
    T = np.linalg.inv(T_tracker_tool) @ T_tracker_tag
    away = T[:3, 3] / np.linalg.norm(T[:3, 3])
    T[:3, 3] += LATERAL * rng.standard_normal(3) + DEPTH * rng.standard_normal() * away
    T[:3, :3] = T[:3, :3] @ Rotation.from_rotvec(TURN * rng.standard_normal(3)).as_matrix()
    return T


def main() -> None:
    """Copy the bag, its poses in another form."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bag", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--as", dest="form", choices=("vrpn", "tf", "tag"), required=True)
    asked = parser.parse_args()
    rng = np.random.default_rng(0)
    with Reader(asked.bag) as reader:
        messages = [(c.topic, c.msgtype, stamp, data) for c, stamp, data in reader.messages()]
    read = [TYPES.deserialize_cdr(data, POSES) for topic, _, _, data in messages if topic == "/tracker/pose"]
    T_tracker_tag = np.eye(4)  # half a metre below the middle of where the tool goes
    T_tracker_tag[:3, 3] = np.mean([matrix(m.pose)[:3, 3] for m in read], axis=0) - [0.0, 0.0, 0.5]
    poses = iter(read)
    with Writer(asked.out, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        known: dict[str, Any] = {}
        for topic, kind, stamp, data in messages:
            if topic == "/tracker/pose":
                message = next(poses)
                if asked.form == "vrpn":
                    topic = "/vrpn_mocap/tool/pose"
                else:
                    topic, kind, T = "/tf", TRANSFORMS, matrix(message.pose)
                    named = ("world", "tool_marker") if asked.form == "tf" else (CAMERA, TAG)
                    T = T if asked.form == "tf" else seen_by_camera(T, T_tracker_tag, rng)
                    data = TYPES.serialize_cdr(transforms(message.header, *named, T), kind)
            if topic not in known:
                known[topic] = writer.add_connection(topic, kind, typestore=TYPES)
            writer.write(known[topic], stamp, data)
    print(f"{asked.out}: {len(messages)} messages")


if __name__ == "__main__":
    main()
