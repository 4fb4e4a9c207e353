"""robot_calibration's captures: what of a message is a joint state, a pose and a point."""

from __future__ import annotations

from types import SimpleNamespace as S

import numpy as np
import pytest

from modcal_core.geometry import Array, se3
from modcal_msgs_py.topics import Joints, Reading, added_topics, role_of

GRID = np.array([(0.03 * x, 0.03 * y, 0.0) for x in range(4) for y in range(3)])
T = se3.exp(np.array([0.1, -0.2, 0.9, 0.4, 2.0, -0.3]))


def observation(frame: str, points: Array, focal: float) -> S:
    header = S(frame_id=frame)
    features = [S(header=header, point=S(x=x, y=y, z=z)) for x, y, z in points.tolist()]
    return S(features=features, ext_camera_info=S(camera_info=S(k=np.r_[focal, np.zeros(8)])))


def taken(*observations: S) -> list[Reading]:
    states = S(name=["a", "b"], position=[0.1, 0.2], velocity=[], effort=[])
    joints, *readings = added_topics()["calibration_data"].take(S(joint_states=states, observations=observations))
    assert joints == Joints(["a", "b"], [0.1, 0.2], [], [])
    return [reading for reading in readings if isinstance(reading, Reading)]


@pytest.mark.parametrize("camera_first", [True, False])
def test_features_of_arm_and_camera_are_a_pose(camera_first: bool) -> None:
    both = [observation("optical", se3.apply(T, GRID), 600.0), observation("tool0", GRID, 0.0)]
    (reading,) = taken(*(both if camera_first else both[::-1]))
    assert (reading.kind, reading.frame) == ("pose", "optical")
    x, y, z, qx, qy, qz, qw = reading.values
    assert np.allclose([x, y, z], T[:3, 3], atol=1e-12)
    assert abs(qx**2 + qy**2 + qz**2 + qw**2 - 1.0) < 1e-12
    assert np.degrees(2.0 * np.arccos(abs(qw))) == pytest.approx(np.degrees(np.linalg.norm(se3.log(T)[3:])), abs=1e-6)


def test_one_feature_is_a_point_and_what_no_camera_saw_is_nothing() -> None:
    (reading,) = taken(observation("optical", GRID[4:5], 600.0), observation("tool0", GRID[:1], 0.0))
    assert (reading.kind, list(reading.values)) == ("point", GRID[4].tolist())
    assert taken(observation("tool0", GRID, 0.0)) == []
    assert taken(observation("optical", GRID, 600.0)) == []  # nobody says where on the target the features are


def test_the_topic_in_any_namespace() -> None:
    assert role_of("/fetch/calibration_data", "robot_calibration_msgs/msg/CalibrationData") == "calibration_data"
