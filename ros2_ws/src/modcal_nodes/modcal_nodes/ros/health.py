"""What a node reports on ``/diagnostics``, once a second and at once when it gets better or worse."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.node import Node

from modcal_nodes.ros.guarded import CallbackFaults, GuardedNode

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
_PERIOD = 1.0  # s


@dataclass(frozen=True)
class Status:
    """One line of a node's health. part: what of the node it is about. values: facts behind the message, by name."""

    part: str
    level: bytes
    message: str
    values: Mapping[str, object] = field(default_factory=dict)


class Health:
    """Publishes a node's statuses. ``report`` is asked for them."""

    def __init__(self, node: Node, report: Callable[[], Iterable[Status]]) -> None:
        self._node, self._of = node, report
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._levels: tuple[bytes, ...] = ()
        # wall time: a simulation that stands still must not silence the node that would say so
        node.create_timer(_PERIOD, self.publish, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _report(self) -> list[Status]:
        """What the node says, and what went wrong inside of it; a fault of the telling itself is told too."""
        if not isinstance(self._node, GuardedNode):
            return list(self._of())
        statuses: list[Status] = []
        try:
            statuses.extend(self._of())
        except Exception as error:
            if not self._node.context.ok():
                raise
            self._node.faults.note("report", error)
        if said := self._node.parameters_without_effect:
            statuses.append(Status("parameters", WARN, said))
        return [*statuses, faults_status(self._node.faults)]

    def publish(self) -> None:
        """Publish all statuses now."""
        statuses = self._report()
        message = DiagnosticArray(status=[self._converted(status) for status in statuses])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._levels = tuple(status.level for status in statuses)
        self._publisher.publish(message)

    def publish_last(self, seconds: float = 1.0) -> None:
        """Publish all statuses before the node ends, and give them time to arrive."""
        self.publish()
        self._publisher.wait_for_all_acked(Duration(seconds=seconds))

    def publish_if_changed(self) -> None:
        """Publish now if the level of any status has changed since the last time."""
        if tuple(status.level for status in self._report()) != self._levels:
            self.publish()

    def _converted(self, status: Status) -> DiagnosticStatus:
        return DiagnosticStatus(
            level=status.level,
            name=f"{self._node.get_fully_qualified_name()}: {status.part}",
            hardware_id="modcal",
            message=status.message,
            values=[KeyValue(key=key, value=str(value)) for key, value in status.values.items()],
        )


def faults_status(faults: CallbackFaults) -> Status:
    """The exceptions that callbacks have raised: an error for a while, a warning ever after."""
    total = faults.counts.total()
    if not total:
        return Status("faults", OK, "no callback has failed")
    recent = faults.recent()
    text = f"{total} callbacks have failed, each dropped its message; the last: {faults.last}"
    return Status("faults", ERROR if recent else WARN, text, {f"faults of {k}": n for k, n in faults.counts.items()})
