"""The corrector among hostile messages; a file of its own, for it takes a while."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from modcal_interfaces.msg import Calibration
from nodes.corrected_arm import AWAY, CHAIN, URDF, Arm, calibration, matrix, near, truth, written
from nodes.corrected_arm import message as calibration_message
from nodes.processes import Process, fresh_domain, listener, running
from sensor_msgs.msg import JointState, Temperature
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory

from modcal_msgs_py.readings import seconds, set_seconds

pytestmark = pytest.mark.dds


@contextlib.contextmanager
def hearing_beside(domain: int, arrived: list[tuple[float, JointTrajectory]]) -> Iterator[None]:
    """Notes commands and when they came in a thread that does nothing else, for the test is busy sending."""
    done = threading.Event()

    def work() -> None:
        with listener(domain) as (node, wait):
            node.create_subscription(
                JointTrajectory, "corrector/joint_trajectory", lambda m: arrived.append((time.time(), m)), 1000
            )
            wait(done.is_set, 600.0)

    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def test_thousands_of_hostile_messages_bring_nothing_unsafe(tmp_path: Path) -> None:
    """Whatever is sent, what comes out is finite, of now, within the limits and no farther than the speed allows."""
    rng = np.random.default_rng(5)
    made = calibration()
    domain = fresh_domain()
    stale, horizon, speed = 0.5, 0.25, 0.4
    process = Process(
        "corrector", domain, tmp_path,
        stream=True, timeout_s=stale, horizon_s=horizon, joint_speed_rad_s=speed, calibration=written(made, tmp_path),
    )  # fmt: skip
    arrived: list[tuple[float, JointTrajectory]] = []
    with running(process), hearing_beside(domain, arrived), listener(domain) as (node, wait):
        arm = Arm(node, rate=20.0)
        heat = node.create_publisher(Temperature, "temperature", 10)
        wait(arm.connected, 60.0)
        bad = [math.nan, math.inf, -math.inf, 1e300, -1e300, 0.0, 1e-300]
        sent = dict.fromkeys(("wish", "joints", "heat", "calibration", "robot"), 0)
        good = truth(made, AWAY)

        def wish() -> PoseStamped:
            how = rng.integers(8)
            step = 10.0 ** rng.uniform(-4, 0.5)
            message = arm.wish(near(good, step * rng.normal(), step * rng.normal()))
            if how == 0:
                setattr(message.pose.position, rng.choice(["x", "y", "z"]), float(rng.choice(bad)))
            elif how == 1:
                setattr(message.pose.orientation, rng.choice(["x", "y", "z", "w"]), float(rng.choice(bad)))
            elif how == 2:
                for axis in "xyz":
                    setattr(message.pose.position, axis, 1000.0 * getattr(message.pose.position, axis))
            elif how == 3:
                message.header.frame_id = str(rng.choice(["tracker", "map", "", "base_link", "\n", "tool0"]))
            elif how == 4:
                moment = arm.now() + rng.normal() * 10.0 ** rng.uniform(-2, 9)
                set_seconds(message.header.stamp, float(np.clip(moment, -2e9, 2e9)))
            elif how == 5:
                message.header.stamp.nanosec = 2**32 - 1
            return message

        def joints() -> JointState:
            message = arm.state()
            how = rng.integers(7)
            if how == 0:
                message.position[rng.integers(6)] = float(rng.choice([math.nan, math.inf, -math.inf, 1e300]))
            elif how == 1:
                message.position = [float(x) for x in np.degrees(arm.q)]
            elif how == 2:
                message.name = [f"other_{name}" for name in message.name]
            elif how == 3:
                message.position = list(message.position)[: rng.integers(6)]
            elif how == 4:
                message.name = [*message.name[:5], message.name[0]]
            elif how == 5:
                set_seconds(message.header.stamp, max(1.0, arm.now() + rng.choice([-1, 1]) * rng.uniform(1.0, 1e6)))
                message.position = [float(x) for x in rng.uniform(-3, 3, 6)]
            else:
                message.velocity = [float(x) for x in rng.choice(bad, 6)]
                message.effort = [float(x) for x in rng.choice(bad, 6)]
            return message

        def answer() -> None:
            """Wish for what can be until it is done, in spite of all that was sent before."""
            count = len(arrived)
            for _ in range(200):
                arm.desired.publish(arm.wish(good))
                with contextlib.suppress(AssertionError):
                    return wait(lambda: len(arrived) > count, 0.25)
            raise AssertionError("no answer any more")

        calibrations = [Calibration(), Calibration(version=7), calibration_message(calibration())]
        calibrations[-1].values[3].name = calibrations[-1].values[4].name + "/x"
        for k in range(2000):
            kind = rng.random()
            if kind < 0.6:
                sent["wish"] += 1
                arm.desired.publish(wish())
            elif kind < 0.9:
                sent["joints"] += 1
                arm.joints.publish(joints())
            elif kind < 0.99:
                sent["heat"] += 1
                message = Temperature(temperature=float(rng.choice(bad)))
                message.header.frame_id = str(rng.integers(1000))
                heat.publish(message)
            elif kind < 0.995:
                sent["calibration"] += 1
                arm.calibration.publish(calibrations[rng.integers(len(calibrations))])
            else:
                sent["robot"] += 1
                arm.description.publish(String(data=str(rng.choice(["", "<robot>", "<robot name='x'/>", URDF[:3000]]))))
                wait(lambda: True, 1.0)
                wait(lambda: True, 1.0)
                arm.description.publish(String(data=URDF))
            time.sleep(0.002)
            if k % 5 == 4:
                wait(lambda: True, 1.0)
            if k % 25 == 24:  # let it catch up, for what is overtaken in the queue was not tried; and it still lives
                answer()
        assert process.stop() == 0
    assert "Traceback" not in process.output
    print(process.output[-2000:])
    assert min(sent.values()) > 0
    facts = arm.facts("commands")
    tried = int(facts["refused"]) + int(facts["commands"])
    print(f"sent {sent}, of the wishes tried {tried}, refused {facts['refused']}; commands {len(arrived)}")
    assert tried > 200
    assert int(facts["refused"]) > 70
    assert len(arrived) > 20
    for received, message in arrived:
        assert tuple(message.joint_names) == CHAIN.names
        (point,) = message.points
        q = np.array(point.positions)
        assert np.isfinite(q).all()
        assert ((q >= CHAIN.lower) & (q <= CHAIN.upper)).all()
        assert np.abs(q - arm.q).max() <= speed * horizon + 1e-9
        assert seconds(point.time_from_start) == pytest.approx(horizon)
        assert -0.1 < received - seconds(message.header.stamp) < 2.0
    for pose in arm.poses:
        assert np.isfinite(matrix(pose.pose.pose)).all()
        assert np.abs(matrix(pose.pose.pose) - good).max() < 1e-9
        assert np.isfinite(pose.pose.covariance).all()
