"""A calibrator that watches an arm at its work, by the history of that arm."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from nodes.cell import joint_state
from nodes.processes import Process, fresh_domain, listener, running
from nodes.talking import LATCHED, RELIABLE
from sensor_msgs.msg import JointState
from sentinel.worlds import NONE, ArmWorld, Change
from std_msgs.msg import String

from modcal_core.measurements import Recording
from modcal_core.robots import read_inertias
from modcal_core.sentinel import BagHistory, MonitoredArm, cells_of

WORLD = ArmWorld("ur10", 3)
ARM = MonitoredArm(WORLD.chain.names, WORLD.chain, read_inertias(WORLD.urdf, WORLD.chain))
SECONDS, PIECE = 27.0, 20.0


def commanded(recording: Recording, i: int) -> JointState:
    """The i-th command of a recording as a message, stamped as the joint state of its time."""
    message = joint_state(recording, i)
    message.position = [float(x) for x in recording.commands[0].position[i]]
    return message


@pytest.mark.dds
@pytest.mark.slow
def test_a_calibrator_watches_an_arm_at_its_work(tmp_path: Path) -> None:
    kept = BagHistory(tmp_path / "arm", ARM)
    days = [cells_of(WORLD.record(day, 40.0, 0), ARM.names, f"day {day}") for day in range(12)]
    kept.add(days, "reference")
    domain = fresh_domain()
    calibrator = Process(
        "calibrator", domain, tmp_path, sentinel=tmp_path / "arm", sentinel_every_s=1.0, buffer_s=PIECE
    )
    with running(calibrator), listener(domain) as (node, wait):
        said: list[DiagnosticStatus] = []
        node.create_subscription(DiagnosticArray, "/diagnostics", lambda m: said.extend(m.status), 50)
        states, commands = (node.create_publisher(JointState, n, RELIABLE) for n in ("joint_states", "joint_commands"))
        node.create_publisher(String, "robot_description", LATCHED).publish(String(data=WORLD.urdf))
        wait(lambda: states.get_subscription_count() == 1, 60.0)

        def latest() -> DiagnosticStatus | None:
            return next((s for s in reversed(said) if s.name.endswith("sentinel")), None)

        def play(day: int, change: Change = NONE) -> None:
            made = WORLD.record(day, SECONDS, 0, change)
            for i in range(len(made.joints[0].stamps)):
                message = joint_state(made, i)
                message.effort = [float(x) for x in made.joints[0].effort[i]]
                states.publish(message)
                commands.publish(commanded(made, i))
                if i == 0:
                    wait(lambda: commands.get_subscription_count() == 1, 30.0)
                if i % 4 == 3:
                    time.sleep(0.004)

        wait(latest, 30.0)
        assert "waiting" in latest().message
        play(20)
        wait(lambda: latest().level == DiagnosticStatus.OK, 60.0)
        assert latest().message.startswith("Nothing has changed that")
        play(21, Change("payload", -1, 2.0))
        wait(lambda: latest().level == DiagnosticStatus.WARN, 60.0)
        assert "What the arm carries has changed" in latest().message
        assert {v.key: v.value for v in latest().values}["pieces judged"] == "2"  # what is left of a day is too short
        assert not any(s.name.endswith("model") for s in said)
        assert calibrator.stop() == 0
    assert [cells.name for cells, _ in kept.read("later")] == ["live", "live"]
