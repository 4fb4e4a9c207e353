"""Managed nodes: the lifecycle of ROS 2, kept by the services of lifecycle_msgs, or by the node with ``autostart``.

What a node hears and publishes is made when it is configured. While it is not active it publishes nothing but its
health, and takes only what is latched, which nobody would repeat. Its services and actions are there in every state,
and say no while it is not active, so that nobody waits for an answer. A node does one thing at a time.

rclpy looks at a waiting coroutine in every turn of its executor, so no coroutine waits for the end of an action: an
accepted goal is kept until the node says how its work has ended.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from difflib import get_close_matches
from functools import partial
from importlib import import_module
from typing import Any

from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.action import ActionServer, CancelResponse
from rclpy.action.server import GoalEvent, ServerGoalHandle
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode, LifecyclePublisher, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.parameter import Parameter as Given
from rclpy.qos import QoSProfile
from rclpy.task import Future
from rclpy.timer import Timer
from std_srvs.srv import Trigger

from modcal_core.errors import BadTable, ModcalError
from modcal_msgs_py import require_version
from modcal_nodes.ros.guarded import GuardedNode, Refusals, described
from modcal_nodes.ros.parameters import NODES, Parameter
from modcal_nodes.ros.running import run
from modcal_nodes.ros.subscriptions import OK, WARN, Health, Status
from modcal_nodes.ros.subscriptions import MonitoredSubscription as Monitored

DONE, REFUSED, FAILED, CANCELLED = 1, 2, 3, 4  # outcomes of every action, whatever their names there
_FEEDBACK = 0.2  # s
NO_DESCRIPTION = "robot_description: not received yet: publish it (latched), or set the parameter"


def interface(name: str) -> Any:
    """The message, action or service of that name. Raises BadTable where modcal_interfaces is not built."""
    for kind in ("msg", "action", "srv"):
        try:
            found = getattr(import_module(f"modcal_interfaces.{kind}"), name, None)
        except ImportError as error:
            remedy = "run make build; where ROS is from apt, build the workspace with colcon and source it"
            raise BadTable("package modcal_interfaces", "is not built", remedy) from error
        if found is not None:
            return found
    raise AttributeError(f"modcal_interfaces has no {name}")


class Action:
    """One action: at most one goal at a time, with feedback while it is active."""

    def __init__(
        self,
        node: GuardedNode,
        kind: str,
        begin: Callable[[], str],
        cancel: Callable[[], None],
        progress: Callable[[Any], None],
        trigger: bool = False,
    ) -> None:
        """kind: such as Solve, whose name below the node's is ~/solve. begin: returns why it cannot, or nothing; what
        has begun ends with a call of :meth:`end`. cancel: makes it end soon. progress: fills the feedback. trigger:
        whether a Trigger of the same name is answered with the end of what it begins.
        """
        self._node, self._type, self.name = node, interface(kind), f"~/{kind.lower()}"
        self._begin, self._cancel, self._progress = begin, cancel, progress
        self._goal: ServerGoalHandle | None = None
        self._waiting: Future | None = None
        self._timer: Timer | None = None
        self._begun = 0.0
        self._server = ActionServer(
            node, self._type, self.name, lambda _: None,
            handle_accepted_callback=self._accept, cancel_callback=self._ask_to_cancel,
        )  # fmt: skip
        if trigger:
            # a group of its own: while an end is awaited, its group takes no other callback
            node.create_service(Trigger, self.name, self._await, callback_group=ReentrantCallbackGroup())

    @property
    def active(self) -> bool:
        """Whether a goal is pursued."""
        return self._goal is not None

    @property
    def elapsed(self) -> float:
        """Seconds since something was begun by it."""
        return time.monotonic() - self._begun

    async def _await(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._begun = time.monotonic()
        if refusal := self._node.idle or self._begin():
            response.success, response.message = False, refusal
            return response
        self._waiting = Future(executor=self._node.executor)
        result = await self._waiting
        response.success, response.message = result.outcome == DONE, result.message
        return response

    def end(self, outcome: int, message: str, **fields: Any) -> None:
        """What was going on has ended so. fields: of the result, beside outcome and message."""
        result = self._type.Result(outcome=outcome, message=message, **fields)
        if self._timer is not None:
            self._node.destroy_timer(self._timer)
            self._timer = None
        if self._waiting is not None:
            waiting, self._waiting = self._waiting, None
            waiting.set_result(result)
        if self._goal is not None:
            goal, self._goal = self._goal, None
            self._close(goal, result)

    def _accept(self, goal: ServerGoalHandle) -> None:
        goal._update_state(GoalEvent.EXECUTE)  # execute() would call a function, which had to wait
        if self._goal is not None:
            self._close(goal, self._type.Result(outcome=REFUSED, message=f"{self.name}: another goal is active"))
            return
        self._goal, self._begun = goal, time.monotonic()
        try:
            require_version(goal.request, self.name)
            if refusal := self._node.idle or self._begin():
                self.end(REFUSED, refusal)
        except ModcalError as error:
            self.end(REFUSED, str(error))
        except Exception as error:
            self.end(FAILED, self._node.faults.note(f"action {self.name}", error))
        if self._goal is goal:
            self._timer = self._node.every(_FEEDBACK, self._tell)

    def _tell(self) -> None:
        if self._goal is not None:
            feedback = self._type.Feedback()
            self._progress(feedback)
            self._goal.publish_feedback(feedback)

    def _ask_to_cancel(self, goal: ServerGoalHandle) -> CancelResponse:
        if goal is not self._goal:
            return CancelResponse.REJECT
        try:
            self._cancel()
        except Exception as error:
            self._node.faults.note(f"cancelling {self.name}", error)
        return CancelResponse.ACCEPT

    def _close(self, goal: ServerGoalHandle, result: Any) -> None:
        """Give the goal its result, once it is known whether it was cancelled."""
        self._server.notify_execute(goal, partial(_closed, result))


def _closed(result: Any, goal: ServerGoalHandle) -> Any:
    if result.outcome == DONE:
        goal.succeed()
    elif goal.is_cancel_requested:
        result.outcome = CANCELLED
        goal.canceled()
    else:
        goal.abort()
    return result


def declare(node: Node, parameters: dict[str, Parameter]) -> dict[str, Any]:
    """Declare these parameters on a node, with their bounds; returns their values. rclpy refuses one outside them."""
    for name, parameter in parameters.items():
        descriptor = ParameterDescriptor(description=parameter.description, read_only=not parameter.live)
        if parameter.low is not None and parameter.high is not None:
            if isinstance(parameter.default, int):
                bounds = IntegerRange(from_value=int(parameter.low), to_value=int(parameter.high), step=0)
                descriptor.integer_range = [bounds]
            else:
                span = FloatingPointRange(from_value=float(parameter.low), to_value=float(parameter.high), step=0.0)
                descriptor.floating_point_range = [span]
        _widen(node, name, parameter)
        node.declare_parameter(name, parameter.default, descriptor)
    _warn_of_unknown(node, parameters)
    return {name: node.get_parameter(name).value for name in parameters}


def _widen(node: Node, name: str, parameter: Parameter) -> None:
    """Take what is given as 50 for the 50.0 that it means; rclpy refuses a whole number for one with a point."""
    given = node._parameter_overrides.get(name)
    whole = isinstance(given.value, int) and not isinstance(given.value, bool) if given is not None else False
    if given is not None and whole and isinstance(parameter.default, float):
        node._parameter_overrides[name] = Given(name, value=float(given.value))


def _warn_of_unknown(node: Node, parameters: dict[str, Parameter]) -> None:
    """Say which of the names that files and command line give are no parameter of this node, and which are meant.

    A file may be shared by several nodes: what another one knows is not spoken of, and the rest is no reason to refuse
    the start.
    """
    known = {name for parameters in NODES.values() for name in parameters}
    given = getattr(node, "_parameter_overrides", {})
    strange = [name for name in given if not name.startswith("qos_overrides.") and name not in known]
    said = []
    for name in sorted(name for name in strange if not node.has_parameter(name)):
        like = get_close_matches(name, parameters, 1)
        said.append(f"{name} is not known{f', {like[0]} is' if like else ''}")
    if said:
        text = f"parameters without effect: {'; '.join(said)}: correct the name, or leave it out"
        node.get_logger().warning(text)
        node.parameters_without_effect = text


class HealthyNode(GuardedNode):
    """A node with parameters, which it follows while it runs, with health, and with refusals of what it hears."""

    executable: str  # its name, by which its parameters are known
    rest = 0.0  # s between two looks for messages, see run
    configured = True

    def __init__(self) -> None:
        super().__init__(self.executable)
        self._chosen = declare(self, NODES[self.executable])
        self._check(self._chosen)
        self.add_on_set_parameters_callback(self._judge)
        self.add_post_set_parameters_callback(self._apply)
        self._health = Health(self, self._statuses)
        self._refusals = Refusals(self, self._health.publish_if_changed)

    @classmethod
    def main(cls) -> None:
        """Entry point of the executable."""
        run(cls, rest=cls.rest)

    def _check(self, new: dict[str, Any]) -> None:
        """Raises ModcalError for parameters that cannot be, all of them as they would be."""

    def _take_parameters(self) -> object:
        """Called after a change of parameters while the node is configured."""

    def _report(self) -> Iterable[Status]:
        """The health of a configured node."""
        return ()

    def hear(self, kind: type, topic: str, take: Callable[[Any], None], qos: QoSProfile, **options: Any) -> Monitored:
        """A subscription whose refusals are said and counted. options: of MonitoredSubscription."""
        return Monitored(self, kind, topic, self._refusals.guarded(topic, take), qos, **options)

    def _statuses(self) -> Iterable[Status]:
        return self._report()

    def _changed(self, parameters: list[Any]) -> dict[str, Any]:
        return {p.name: p.value for p in parameters if p.name in self._chosen}

    def _judge(self, parameters: list[Any]) -> SetParametersResult:
        try:
            self._check({**self._chosen, **self._changed(parameters)})
        except ModcalError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply(self, parameters: list[Any]) -> None:
        self._chosen.update(self._changed(parameters))
        if self.configured:
            self._take_parameters()


def _transition(name: str, act: str, refused: Any = TransitionCallbackReturn.FAILURE) -> Any:
    """Callback of a transition, made by a method. refused: its outcome after a ModcalError or OSError."""

    def transition(self: ManagedNode, _: LifecycleState) -> TransitionCallbackReturn:
        if name != "recovery":  # from the transition that failed, which stays said
            self._why, self._outcome = None, ""
        try:
            getattr(self, act)()
        except (ModcalError, OSError) as error:
            self._why, self._outcome = error, f"{name} failed: {described(error)}"
            if not self._chosen["autostart"] or self.configured:  # else the node ends with this line
                self.get_logger().error(self._outcome)
            return refused
        except Exception as error:
            self._why, self._outcome = error, self.faults.note(name, error)
            return TransitionCallbackReturn.ERROR
        return TransitionCallbackReturn.SUCCESS

    return transition


_HEARING = ("timer", "subscription", "publisher")


class ManagedNode(HealthyNode, LifecycleNode):
    """Base of a managed node: parameters, health, refusals, services and actions are there in every state.

    A subclass makes its services and actions in :meth:`_serve`, and everything else in :meth:`_configure`; what is to
    be closed with it goes into ``held``. Timers made in :meth:`_activate` end when the node is deactivated. A
    ModcalError or OSError in these methods refuses the transition; at a start by ``autostart`` it ends the node. A
    transition that the state does not allow, for which rclpy raises, is answered.
    """

    active = configured = False
    _own: frozenset[int] | None = None  # entities of every state, by id

    def __init__(self) -> None:
        super().__init__()
        changes = self._service_change_state
        self._change_state = changes.callback.callback  # without its guard: what is illegal is no fault
        changes.callback = self.guarded_service("change_state", self._transit)
        self.held = ExitStack()
        self._why: Exception | None = None  # of the last transition that failed
        self._outcome = ""
        self._ticking: set[Any] = set()
        self.said, self.level = "", OK  # of what is going on
        self._serve()
        self._own = frozenset(id(entity) for kind in _HEARING for entity in getattr(self, f"{kind}s"))
        if self._chosen["autostart"]:
            for transition in (self.trigger_configure, self.trigger_activate):
                if transition() != TransitionCallbackReturn.SUCCESS and self._why is not None:
                    raise self._why

    def _serve(self) -> None:
        """Make services and actions."""

    def _configure(self) -> None:
        """Make what the node hears and publishes."""

    def _activate(self) -> None:
        """Begin; messages are taken and published from now on."""

    def _deactivate(self) -> None:
        """End what is going on; nothing is published afterwards."""

    def _tell(self, level: bytes, said: str) -> None:
        """Say what is going on, and log it where it is news; each severity has a line of its own for rclpy."""
        if (level, said) != (self.level, self.said):
            log = self.get_logger()
            if level == OK:
                log.info(said)
            elif level == WARN:
                log.warning(said, throttle_duration_sec=1.0)
            else:
                log.error(said)
        self.level, self.said = level, said

    def _statuses(self) -> Iterator[Status]:
        if self.configured:
            yield from self._report()
        yield Status("lifecycle", OK if self.active else WARN, self._outcome or self.state)

    @property
    def state(self) -> str:
        """Label of the present state."""
        return str(self._state_machine.current_state[1])

    @property
    def idle(self) -> str:
        """Why nothing is begun now; empty: something can be."""
        return "" if self.active else f"{self.get_name()} is {self.state}: activate it first"

    on_configure = _transition("configure", "_configuring")
    on_activate = _transition("activate", "_activating")
    on_deactivate = _transition("deactivate", "_deactivating")
    on_cleanup = _transition("cleanup", "_cleaning", TransitionCallbackReturn.ERROR)
    on_shutdown = _transition("shutdown", "close")
    on_error = _transition("recovery", "_cleaning", TransitionCallbackReturn.ERROR)

    def close(self) -> None:
        """End what is going on, and close what is held."""
        try:
            if self.active:
                self._deactivate()
        finally:
            self._pause()
            self.configured = False
            self.held.close()

    def _configuring(self) -> None:
        try:
            self._configure()
        except Exception:
            self._cleaning()
            raise
        self.configured = True

    def _activating(self) -> None:
        self.active, before = True, set(self.timers)
        for publisher in self._managed_entities:
            publisher.on_activate(None)
        try:
            try:
                self._activate()
            finally:
                self._ticking = set(self.timers) - before
        except Exception:
            self._pause()
            raise

    def _deactivating(self) -> None:
        self._deactivate()
        self._pause()

    def _pause(self) -> None:
        self.active = False
        for publisher in self._managed_entities:
            publisher.on_deactivate(None)
        for timer in self._ticking:
            self.destroy_timer(timer)
        self._ticking.clear()

    def _cleaning(self) -> None:
        self._pause()
        self.configured = False
        try:
            self.held.close()
        finally:
            self.pollers.clear()
            for kind in _HEARING:
                for entity in list(getattr(self, f"{kind}s")):
                    if id(entity) not in (self._own or ()):
                        getattr(self, f"destroy_{kind}")(entity)

    def _transit(self, request: ChangeState.Request, response: ChangeState.Response) -> ChangeState.Response:
        try:
            response = self._change_state(request, response)
        except rclpy_implementation.RCLError:
            response.success = False
        if not response.success:
            asked = request.transition
            self._refused(f"transition {asked.label or asked.id} is refused in state {self.state}")
        return response

    def _refused(self, said: str) -> None:
        """Say what became of a transition that was not made."""
        if self._why is None:
            self._outcome = f"{said}: see ~/get_available_transitions"
            self.get_logger().warning(self._outcome)
        self._why = None
        self._health.publish()

    def create_publisher(self, msg_type: Any, topic: str, qos_profile: Any, *args: Any, **options: Any) -> Any:
        """Same as in GuardedNode; what is published while the node is not active is dropped."""
        if self._own is None:
            return super().create_publisher(msg_type, topic, qos_profile, *args, **options)
        options["publisher_class"] = LifecyclePublisher
        publisher = super().create_publisher(msg_type, topic, qos_profile, *args, **options)
        self.add_managed_entity(publisher)
        if self.active:
            publisher.on_activate(None)
        return publisher

    def destroy_publisher(self, publisher: Any) -> bool:
        """Same as in Node."""
        self._managed_entities.discard(publisher)
        return bool(super().destroy_publisher(publisher))
