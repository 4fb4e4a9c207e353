"""Managed nodes: the lifecycle of ROS 2, kept by the services of lifecycle_msgs, or by the node with ``autostart``.

What a node hears, serves and publishes is made while it is configured, and destroyed when it is cleaned up. While it is
inactive it publishes nothing but its health, answers its services with a no, and takes only what is latched, which
nobody would repeat.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from typing import Any

from lifecycle_msgs.srv import ChangeState
from rclpy.action import ActionServer
from rclpy.clock import Clock, ClockType
from rclpy.executors import await_or_execute
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode, LifecyclePublisher, LifecycleState, TransitionCallbackReturn

from modcal_core.errors import ModcalError
from modcal_nodes.ros.declaring import declare, follow
from modcal_nodes.ros.guarded import GuardedNode, Refusals, described, refusal
from modcal_nodes.ros.parameters import Parameter
from modcal_nodes.ros.subscriptions import OK, WARN, Health, Status

RCLError = rclpy_implementation.RCLError
_LEAVE = 1.0  # s from a cleanup until services are destroyed: who was told no by it gets that answer


class StatedNode(GuardedNode, LifecycleNode):
    """A lifecycle node that answers a transition which its state does not allow; rclpy raises for it."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        changes = self._service_change_state
        self._change_state = changes.callback.callback  # without its guard: what is illegal is no fault
        changes.callback = self.guarded_service("change_state", self._transit)

    @property
    def state(self) -> str:
        """Label of the present state."""
        return str(self._state_machine.current_state[1])

    def _transit(self, request: ChangeState.Request, response: ChangeState.Response) -> ChangeState.Response:
        try:
            response = self._change_state(request, response)
        except RCLError:
            response.success = False
        if not response.success:
            asked = request.transition
            self._refused(f"transition {asked.label or asked.id} is refused in state {self.state}")
        return response

    def _refused(self, said: str) -> None:
        """Called after a transition that was not made."""


class ManagedNode(StatedNode):
    """Base of a managed node: parameters, health and refusals are there in every state, the rest follows the state.

    A subclass makes everything else in :meth:`_configure`, and what has to be ended with it goes into ``held``. Timers
    made in :meth:`_activate` end when the node is deactivated. A ModcalError or OSError in these methods refuses the
    transition; at a start by ``autostart`` it ends the node.
    """

    active = configured = False
    _own: frozenset[int] | None = None  # entities of every state, by id

    def __init__(self, name: str, parameters: dict[str, Parameter]) -> None:
        super().__init__(name)
        self._chosen = declare(self, parameters)
        self._check(self._chosen)
        follow(self, parameters, self._chosen, self._check, self._follow_parameters)
        self.held = ExitStack()
        self._why: Exception | None = None  # of the last transition that failed
        self._outcome = ""
        self._ticking: list[Any] = []
        self._health = Health(self, self._statuses)
        self._refusals = Refusals(self, self._health.publish_if_changed)
        self._leaving: list[tuple[Any, Callable[[Any], object]]] = []
        self._later = self.create_timer(_LEAVE, self._sweep, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._later.cancel()
        self._own = frozenset(id(entity) for entity, _ in (*self._serving(), *self._speaking()))
        if self._chosen["autostart"]:
            for transition in (self.trigger_configure, self.trigger_activate):
                if transition() != TransitionCallbackReturn.SUCCESS and self._why is not None:
                    raise self._why

    def _check(self, new: dict[str, Any]) -> None:
        """Raises ModcalError for parameters that cannot be."""

    def _take_parameters(self) -> None:
        """Called after a change of parameters while the node is configured."""

    def _configure(self) -> None:
        """Make what the node hears, serves and publishes."""

    def _activate(self) -> None:
        """Begin; messages are taken and published from now on."""

    def _deactivate(self) -> None:
        """End what is going on; nothing is published afterwards."""

    def _report(self) -> Iterable[Status]:
        """The health of a configured node."""
        return ()

    def _follow_parameters(self) -> None:
        if self.configured:
            self._take_parameters()

    def _statuses(self) -> Iterator[Status]:
        if self.configured:
            yield from self._report()
        yield Status("lifecycle", OK if self.active else WARN, self._outcome or self.state, {"state": self.state})

    @property
    def idle(self) -> str:
        """Why nothing is begun now; empty: something can be."""
        return "" if self.active else f"{self.get_name()} is {self.state}: activate it first"

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Make everything; what was made of it is destroyed where that fails."""

        def build() -> None:
            self._sweep()
            try:
                self._configure()
            except Exception:
                self._clear()
                raise
            self.configured = True

        return self._make("configure", build)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Publish, and take messages."""

        def begin() -> None:
            self.active, before = True, set(self.timers)
            super(ManagedNode, self).on_activate(state)
            try:
                self._activate()
            except Exception:
                self._pause()
                raise
            finally:
                self._ticking += [timer for timer in self.timers if timer not in before]

        return self._make("activate", begin)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """End what is going on, and publish no more."""

        def rest() -> None:
            self._deactivate()
            self._pause()

        return self._make("deactivate", rest)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Close what is held, and destroy what was made; a node that cannot is unconfigured all the same."""
        return self._make("cleanup", self._clear, TransitionCallbackReturn.ERROR)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """The end; callers that wait are answered still."""
        return self._make("shutdown", self.close)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """After a fault in a transition: as before it was configured."""
        return self._make("clearing up", self._clear, TransitionCallbackReturn.ERROR, self._outcome)

    def close(self) -> None:
        """End what is going on, and close what is held."""
        try:
            if self.active:
                self._deactivate()
        finally:
            self._pause()
            self.configured = False
            self.held.close()

    def _make(
        self,
        name: str,
        act: Callable[[], None],
        refused: TransitionCallbackReturn = TransitionCallbackReturn.FAILURE,
        said: str = "",
    ) -> TransitionCallbackReturn:
        """Outcome of a transition, whose error is kept and said. refused: outcome after a ModcalError or OSError."""
        self._why, self._outcome = None, said
        try:
            act()
        except (ModcalError, OSError) as error:
            self._why, self._outcome = error, f"{name} failed: {described(error)}"
            if not self._chosen["autostart"] or self.configured:  # else the node ends with this line
                self.get_logger().error(self._outcome)
            return refused
        except Exception as error:
            self._why, self._outcome = error, self.faults.note(name, error)
            return TransitionCallbackReturn.ERROR
        return TransitionCallbackReturn.SUCCESS

    def _refused(self, said: str) -> None:
        if self._why is None:
            self._outcome = f"{said}: see ~/get_available_transitions"
            self.get_logger().warning(self._outcome)
        self._why = None
        self._health.publish()

    def _pause(self) -> None:
        self.active = False
        for publisher in self._managed_entities:
            publisher.on_deactivate(None)
        for timer in self._ticking:
            self.destroy_timer(timer)
        self._ticking.clear()

    def _clear(self) -> None:
        self._pause()
        self.configured = False
        try:
            self.held.close()
        finally:
            self.pollers.clear()
            for entity, destroy in self._speaking():
                if id(entity) not in (self._own or ()):
                    destroy(entity)
            self._leaving = [one for one in self._serving() if id(one[0]) not in (self._own or ())]
            self._later.reset()

    def _sweep(self) -> None:
        """Destroy services and actions of a configuration that has ended, whose callers have their answers by now."""
        self._later.cancel()
        for entity, destroy in self._leaving:
            destroy(entity)
        self._leaving.clear()

    def _serving(self) -> Iterator[tuple[Any, Callable[[Any], object]]]:
        """Services and actions, and how each is destroyed."""
        yield from [(w, ActionServer.destroy) for w in self.waitables if isinstance(w, ActionServer)]
        yield from [(service, self.destroy_service) for service in self.services]

    def _speaking(self) -> Iterator[tuple[Any, Callable[[Any], object]]]:
        """Topics and timers, and how each is destroyed."""
        yield from [(timer, self.destroy_timer) for timer in self.timers]
        yield from [(subscription, self.destroy_subscription) for subscription in self.subscriptions]
        yield from [(publisher, self.destroy_publisher) for publisher in self.publishers]

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

    def create_service(self, srv_type: Any, srv_name: str, callback: Any, *args: Any, **options: Any) -> Any:
        """Same as in GuardedNode; while the node is not active, callers are told so."""
        if self._own is None:
            return super().create_service(srv_type, srv_name, callback, *args, **options)

        async def gated(request: Any, response: Any) -> Any:
            if self.idle:
                return refusal(request, response, self.idle)
            return await await_or_execute(callback, request, response)

        return super().create_service(srv_type, srv_name, gated, *args, **options)
