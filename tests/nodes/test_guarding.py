"""An exception in any callback of any node costs what was being handled, is said and counted, and ends nothing."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from nodes.in_process import Pair, spun
from nodes.talking import LATCHED
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.qos import DurabilityPolicy
from std_msgs.msg import String
from std_srvs.srv import Trigger

from modcal_nodes.nodes.acceleration_limits import AccelerationLimits
from modcal_nodes.nodes.articulation_estimator import ArticulationEstimator
from modcal_nodes.nodes.calibrator import Calibrator
from modcal_nodes.nodes.corrector import Corrector
from modcal_nodes.nodes.door_demo import DoorDemo
from modcal_nodes.nodes.impedance_setpoint import ImpedanceSetpoint
from modcal_nodes.nodes.recorder import Recorder
from modcal_nodes.nodes.simulated_cell import SimulatedCell
from modcal_nodes.nodes.simulated_furniture import SimulatedFurniture
from modcal_nodes.nodes.trajectory_sender import TrajectorySender
from modcal_nodes.nodes.viewer import Viewer
from modcal_nodes.ros.guarded import Guarded, GuardedNode

pytestmark = pytest.mark.dds

URDF = Path(__file__).resolve().parents[2] / "examples" / "robots" / "ur10.urdf"
NODES: dict[str, tuple[Callable[[], GuardedNode], dict[str, Any]]] = {
    "recorder": (Recorder, {}),
    "calibrator": (Calibrator, {}),
    "corrector": (Corrector, {}),
    "articulation_estimator": (ArticulationEstimator, {}),
    "impedance_setpoint": (ImpedanceSetpoint, {"autostart": True}),
    "acceleration_limits": (AccelerationLimits, {}),
    "viewer": (Viewer, {}),
    "simulated_cell": (SimulatedCell, {"urdf": URDF, "stations": 2}),
    "simulated_furniture": (SimulatedFurniture, {"urdf": URDF, "seed": 3, "kind": "drawer"}),
    "trajectory_sender": (TrajectorySender, {"trajectory": "planned.yaml", "patience_s": 600.0}),
    "door_demo": (DoorDemo, {"start": "false", "patience_s": 600.0}),
}
PLANNED = "{joint_names: [a], points: [{positions: [0.0], time_from_start: {sec: 0, nanosec: 0}}]}"


class Boom(Exception):
    """What no code expects."""


def boom(*_: Any) -> Any:
    raise Boom("thrown in a test")


async def boom_later(*_: Any) -> Any:
    raise Boom("thrown in a test")


@pytest.fixture(params=NODES)
def pair(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Pair]:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "planned.yaml").write_text(PLANNED)
    make, parameters = NODES[request.param]
    with spun(make, **parameters) as made:
        if request.param == "impedance_setpoint":
            made.wait(lambda: made.node.active, 10.0)
        yield made


def guard_of(entity: Any) -> Guarded:
    """The guard around an entity's callback; there must be one."""
    callback = getattr(entity.callback, "guarded", entity.callback)
    assert isinstance(callback, Guarded), entity
    return callback


def test_an_exception_in_every_callback(pair: Pair) -> None:
    """Every subscription hears a message, every timer comes due, every service is asked, and every one of them fails."""
    node, partner = pair.node, pair.partner
    assert isinstance(node, GuardedNode)
    heard = pair.told()
    if isinstance(node, Recorder):  # it subscribes to what there is
        talk = partner.create_publisher(DiagnosticStatus, "wrench", 10)
        pair.wait(lambda: any(s.topic_name == "/wrench" for s in node.subscriptions), 10.0)
    health = [guard_of(timer) for timer in node.timers if guard_of(timer).place == "timer publish"]
    guards = {}
    timers = [timer for timer in node.timers if not timer.is_canceled()]
    for entity in [*node.subscriptions, *timers, *node.services]:
        guard = guard_of(entity)
        if guard not in health:  # which tells what we want to hear
            guards[guard.place] = guard
            guard.callback = boom_later if hasattr(entity.callback, "guarded") else boom
    for subscription in list(node.subscriptions):
        profile = LATCHED if subscription.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL else 10
        talk = partner.create_publisher(subscription.msg_type, subscription.topic_name, profile)
        pair.wait(lambda talk=talk: talk.get_subscription_count(), 10.0)
        talk.publish(subscription.msg_type())
        place = guard_of(subscription).place
        pair.wait(lambda place=place: node.faults.counts[place], 10.0)
    services = list(node.services)
    pair.meet((service.srv_type, service.service_name) for service in services)
    for service in services:
        answer = pair.call(service.srv_type, service.service_name)
        if hasattr(answer, "success"):
            assert not answer.success
        if hasattr(answer, "message"):
            assert "Boom: thrown in a test" in answer.message
    pair.wait(lambda: all(node.faults.counts[place] for place in guards), 15.0)
    name = f"{node.get_fully_qualified_name()}: faults"
    pair.wait(lambda: [s for s in heard if s.name == name and s.level == DiagnosticStatus.ERROR], 10.0)
    told = [s for s in heard if s.name == name and s.level == DiagnosticStatus.ERROR][-1]
    assert "Boom: thrown in a test at test_guarding.py" in told.message
    assert {pair.key for pair in told.values} <= {f"faults of {place}" for place in guards}


def test_one_bad_message_of_a_burst_costs_itself(tmp_path: Path) -> None:
    """What waits behind it is handled in the same call, and is not lost."""
    with spun(Viewer) as pair:
        subscription = next(subscription for subscription in pair.node._inputs if subscription.topic == "/temperature")
        handled, inner = [], subscription._callback

        def third_fails(message: Any) -> None:
            handled.append(message.temperature)
            if len(handled) == 3:
                raise Boom("the third")

        inner.callback = third_fails
        talk = pair.partner.create_publisher(subscription._kind, "temperature", 10)
        pair.wait(talk.get_subscription_count, 10.0)
        for k in range(6):
            talk.publish(subscription._kind(temperature=float(k)))
        pair.wait(lambda: len(handled) == 6, 10.0)
        assert handled == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
        assert pair.node.faults.counts["temperature"] == 1


@pytest.mark.parametrize("outer", [False, True])
def test_a_latched_message_is_tried_once_more(outer: bool) -> None:
    """Nobody repeats a robot_description; a fault, whichever guard it meets, must not leave a node without it for ever."""
    with spun(Viewer) as pair:
        node = pair.node
        subscription = next(s for s in node.subscriptions if s.topic_name == "/robot_description")
        monitored = next(one for one in node._inputs if one.topic == "/robot_description")
        (guard_of(subscription) if outer else monitored._callback).callback = boom
        talk = pair.partner.create_publisher(String, "robot_description", LATCHED)
        talk.publish(String(data=URDF.read_text()))
        pair.wait(lambda: node.faults.counts["robot_description"] == 1, 10.0)
        assert not node._urdf
        pair.wait(lambda: node._urdf, 10.0)
        assert node.faults.counts["robot_description"] == 1


def test_a_fault_while_a_parameter_is_set_refuses_it() -> None:
    with spun(Corrector) as pair:
        next(iter(pair.node._on_set_parameters_callbacks)).callback = boom
        value = Parameter(name="target", value=ParameterValue(type=4, string_value="tool"))
        answer = pair.call(SetParameters, "/corrector/set_parameters", SetParameters.Request(parameters=[value]))
        assert not answer.results[0].successful
        assert "Boom" in answer.results[0].reason
        assert pair.node.get_parameter("target").value == "tip"
        assert pair.call(Trigger, "/corrector/reset").success


def test_a_fault_in_the_telling_is_told() -> None:
    with spun(Corrector) as pair:
        heard = pair.told()
        pair.node._health._of = boom
        pair.wait(lambda: [s for s in heard if s.name.endswith("faults") and "Boom" in s.message], 10.0)


def test_the_beat_of_a_simulation_goes_on_after_a_fault() -> None:
    make, parameters = NODES["simulated_cell"]
    with spun(make, **parameters) as pair:
        node: Any = pair.node
        sent = node._beat.callback
        node._beat.callback = boom
        pair.wait(lambda: node.faults.counts["beat"] > 3, 10.0)
        node._beat.callback = sent
        count = node._grids["joint_states"].count
        pair.wait(lambda: node._grids["joint_states"].count > count + 10, 10.0)
