"""Callbacks that may fail without ending their node: a fault costs the one message, and is said and counted.

Every node is a :class:`GuardedNode`; what it hands to rclpy (subscriptions and their events, timers, services,
parameter callbacks) is wrapped here, the built-in services included. A deliberate end of the node is :class:`NodeEnds`.
"""

from __future__ import annotations

import inspect
import math
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable
from copy import copy
from functools import update_wrapper
from pathlib import Path
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.action import ActionClient, ActionServer
from rclpy.clock import Clock, ClockType
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from std_srvs.srv import Trigger

from modcal_core.errors import ModcalError


def waiting(subscription: Subscription, most: int, raw: bool = False) -> list[tuple[Any, dict[str, Any]]]:
    """(message, info) of at most so many messages that have arrived; raw: as CDR bytes.

    By way of the executor each message costs ten times as much, and a kilohertz would be more than it can bring. The
    limit lets other topics, timers and services have their turn.
    """
    out = list[tuple[Any, dict[str, Any]]]()
    handle, kind = subscription.handle, subscription.msg_type
    with handle:
        while len(out) < most and (taken := handle.take_message(kind, raw)) is not None:
            out.append(taken)
    return out


_STEADY = Clock(clock_type=ClockType.STEADY_TIME)
_AGAIN = 1.0  # s after a fault until a latched message is handled once more
_RECENT = 10.0  # s in which a fault counts as recent
_THROTTLE = 1.0  # s between two lines in the log about the same place
_OVERRIDABLE = (QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY, QoSPolicyKind.DURABILITY)


class NodeEnds(Exception):
    """Raised by a callback that wants its node to end with this error, exit code 2."""

    def __init__(self, error: ModcalError) -> None:
        super().__init__(str(error))
        self.error = error


class CallbackFaults:
    """Exceptions that callbacks have raised, by place: a topic, a service, a timer's function. For any thread."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self.counts: Counter[str] = Counter()
        self._last: tuple[float, str] | None = None
        self._said: dict[str, float] = {}
        self._lock = threading.Lock()

    def note(self, place: str, error: Exception) -> str:
        """Count and log a fault; returns its sentence."""
        said = f"{place}: {described(error)}"
        now = time.monotonic()
        with self._lock:
            self.counts[place] += 1
            self._last = now, said
            quiet = now - self._said.get(place, -_THROTTLE) < _THROTTLE
            if not quiet:
                self._said[place] = now
        if not quiet:
            log = self._node.get_logger()
            log.error(f"fault in {said}; the message being handled is dropped, the node continues")
            log.debug("".join(traceback.format_exception(error)))
        return said

    def recent(self) -> str:
        """The last fault if it is recent, else nothing."""
        last = self._last
        return last[1] if last is not None and time.monotonic() - last[0] < _RECENT else ""

    @property
    def last(self) -> str:
        """The last fault, however long ago; empty: there was none."""
        return self._last[1] if self._last is not None else ""


def described(error: Exception) -> str:
    """An exception in one line: the message of a refusal, else what was raised and where."""
    if isinstance(error, ModcalError):
        return str(error)
    frames = traceback.extract_tb(error.__traceback__)
    where = f" at {Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else ""
    return " ".join(f"{type(error).__name__}: {error}{where}".split())


class Guarded:
    """A callback whose exceptions are noted and not passed on. callback: may be replaced, as tests do."""

    def __init__(
        self, node: GuardedNode, place: str, callback: Callable[..., Any], instead: Callable[..., Any] | None = None
    ) -> None:
        """instead: makes the answer after a fault, from the arguments and the fault's sentence; None: nothing."""
        self.node, self.place, self.callback, self._instead = node, place, callback, instead
        update_wrapper(self, callback)  # rclpy asks how many arguments it takes

    def __call__(self, *args: Any) -> Any:
        """Call it; a fault is noted, and answered where an answer is due."""
        try:
            return self.callback(*args)
        except Exception as error:
            return self._after(error, args)

    def _after(self, error: Exception, args: tuple[Any, ...]) -> Any:
        if isinstance(error, NodeEnds | ExternalShutdownException):
            raise error
        if not self.node.context.ok():  # rcl raises for everything that is published after the end
            raise error
        said = self.node.faults.note(self.place, error)
        return self._instead(*args, said) if self._instead is not None else None

    def awaited(self) -> Callable[..., Any]:
        """The same for a coroutine function."""

        async def guarded(*args: Any) -> Any:
            try:
                return await self.callback(*args)
            except Exception as error:
                return self._after(error, args)

        update_wrapper(guarded, self.callback)
        guarded.guarded = self  # type: ignore[attr-defined]
        return guarded


class GuardedNode(Node):
    """A node whose callbacks cannot end it. Stands first among the bases: ``class Arm(GuardedNode, LifecycleNode)``."""

    _faults: CallbackFaults | None = None
    parameters_without_effect = ""  # what is said of those that no node knows (see lifecycle.py)
    most_at_once = 100  # messages of one topic before others have their turn
    active: bool = True  # whether messages are taken; of a managed node, see lifecycle.py

    def __init__(self, *args: Any, **options: Any) -> None:
        self.pollers: list[Callable[[], int]] = []  # take what waits in a subscription; how much that was
        super().__init__(*args, **{"enable_logger_service": True, **options})
        for service in self.services:  # those that rclpy makes without asking create_service
            if not _is_guarded(service.callback):
                service.callback = self.guarded_service(service.srv_name, service.callback)

    @property
    def faults(self) -> CallbackFaults:
        """What callbacks have raised so far."""
        if self._faults is None:
            self._faults = CallbackFaults(self)
        return self._faults

    @property
    def hurried(self) -> bool:
        """Whether it has no time to rest now (see running.py)."""
        return False

    @property
    def idle(self) -> str:
        """Why no service or action begins anything now; empty: they do."""
        return ""

    def _now(self) -> float:
        return 1e-9 * self.get_clock().now().nanoseconds

    def close(self) -> None:
        """End what is going on, before the node is taken away."""

    def destroy_node(self) -> None:
        """Same as in Node, with the actions, which Node forgets."""
        for waitable in list(self.waitables):
            if isinstance(waitable, ActionServer | ActionClient):
                waitable.destroy()
        super().destroy_node()

    def take_time(self) -> None:
        """Take the simulated time that has arrived, if there is one."""
        if self.get_clock().ros_time_is_active:
            for subscription in list(self.subscriptions):
                if subscription.topic_name == "/clock":
                    for message, _ in waiting(subscription, self.most_at_once):
                        subscription.callback(message)

    def take_waiting(self) -> int:
        """Take the messages that have arrived; the most that were of one topic.

        Simulated time comes first, and again before each topic: one whose messages take long would look ahead of it.
        """
        most, simulated = 0, self.get_clock().ros_time_is_active
        for poll in self.pollers:
            if simulated:
                self.take_time()
            most = max(most, poll())
        return most

    def guarded(self, place: str, callback: Callable[..., Any]) -> Callable[..., Any]:
        """A callback whose exceptions cost what it was called for, and no more."""
        return callback if _is_guarded(callback) else Guarded(self, place, callback)

    def create_publisher(self, msg_type: Any, topic: str, qos_profile: Any, *args: Any, **options: Any) -> Any:
        """Same as Node.create_publisher, with the QoS of the parameters qos_overrides.TOPIC.publisher.POLICY."""
        qos_profile = self._overridden(topic, "publisher", qos_profile, options)
        return super().create_publisher(msg_type, topic, qos_profile, *args, **options)

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Any, qos_profile: Any, *args: Any, **options: Any
    ) -> Any:
        """Same as Node.create_subscription, with a guarded callback and the QoS of the parameters
        qos_overrides.TOPIC.subscription.POLICY.
        """
        qos_profile = self._overridden(topic, "subscription", qos_profile, options)
        events = options.get("event_callbacks")
        for name, event in vars(events).items() if events is not None else ():
            if event is not None and callable(event):
                setattr(events, name, self.guarded(f"{topic}, {name}", event))
        guarded = self.guarded_once_more(topic, callback) if is_latched(qos_profile) else self.guarded(topic, callback)
        return super().create_subscription(msg_type, topic, guarded, qos_profile, *args, **options)

    def guarded_once_more(self, topic: str, callback: Any) -> Callable[..., Any]:
        """A guarded callback of a latched topic: after a fault the message, which nobody repeats, is tried again."""
        if _is_guarded(callback):
            return callback
        plain = self.guarded(topic, callback)

        def again(message: Any, _: str) -> None:
            def retry() -> None:
                timer.cancel()
                plain(message)

            timer = self.every(_AGAIN, retry)

        return Guarded(self, topic, callback, again)

    def create_timer(self, timer_period_sec: float, callback: Any, *args: Any, **options: Any) -> Any:
        """Same as in Node, with a guarded callback."""
        inner = getattr(callback, "func", callback)
        place = f"timer {getattr(inner, '__name__', type(inner).__name__).lstrip('_')}"
        return super().create_timer(timer_period_sec, self.guarded(place, callback), *args, **options)

    def every(self, seconds: float, act: Callable[[], object]) -> Any:
        """A timer of the wall's time: a simulated one may stand, and what would say so, or hold an arm, must not."""
        return self.create_timer(seconds, act, clock=_STEADY)

    def create_service(self, srv_type: Any, srv_name: str, callback: Any, *args: Any, **options: Any) -> Any:
        """Same as in Node, guarded: after a fault the caller is told, if the response has a field for it."""
        return super().create_service(srv_type, srv_name, self.guarded_service(srv_name, callback), *args, **options)

    def offer(self, name: str, act: Callable[[], tuple[bool, str]]) -> None:
        """A service Trigger. act: returns whether it was done, and what is to be said of it; not called while idle."""

        def answer(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            response.success, response.message = (False, self.idle) if self.idle else act()
            return response

        self.create_service(Trigger, name, answer)

    def add_on_set_parameters_callback(self, callback: Any) -> None:
        """Same as in Node, guarded: after a fault the parameters are refused."""
        super().add_on_set_parameters_callback(
            Guarded(self, "parameters", callback, lambda _, said: SetParametersResult(successful=False, reason=said))
        )

    def add_post_set_parameters_callback(self, callback: Any) -> None:
        """Same as in Node, with a guarded callback."""
        super().add_post_set_parameters_callback(self.guarded("parameters", callback))

    def _overridden(self, topic: str, kind: str, qos: Any, options: dict[str, Any]) -> Any:
        """The QoS to ask for; where the user overrides it, a copy that rclpy may change, with the option for that."""
        stated = getattr(self, "_parameter_overrides", {})
        start = f"qos_overrides.{self.resolve_topic_name(topic)}.{kind}." if stated else ""
        if not start or not any(name.startswith(start) for name in stated):
            return qos
        options.setdefault("qos_overriding_options", QoSOverridingOptions(_OVERRIDABLE))
        return copy(qos) if isinstance(qos, QoSProfile) else QoSProfile(depth=qos)

    def guarded_service(self, name: str, callback: Any) -> Callable[..., Any]:
        """A service's callback; after a fault the caller is told no."""
        if _is_guarded(callback):
            return callback
        guarded = Guarded(self, f"service {name}", callback, refusal)
        return guarded.awaited() if inspect.iscoroutinefunction(callback) else guarded


def _is_guarded(callback: Any) -> bool:
    return isinstance(callback, Guarded) or hasattr(callback, "guarded")


def is_latched(qos: Any) -> bool:
    """Whether a publisher that offers this QoS tells its last message to whoever comes later."""
    return isinstance(qos, QoSProfile) and qos.durability == DurabilityPolicy.TRANSIENT_LOCAL


def refusal(request: Any, response: Any, said: str) -> Any:
    """An answer that says no, as far as its type can."""
    answer = type(response)()
    if hasattr(answer, "success"):
        answer.success = False
    for words in ("message", "reason", "status_message"):
        if hasattr(answer, words):
            setattr(answer, words, said)
    return answer


_SAID_FOR = 5.0  # s that diagnostics go on telling of a refusal
_REFUSALS_THROTTLE = 2.0  # s between two lines in the log


class Refusals:
    """What was refused of late, by part: the topic it came on, or what of the node it is about."""

    def __init__(self, node: Node, news: Callable[[], None] = lambda: None) -> None:
        """news: called when a part refuses something that had refused nothing of late."""
        self._node, self._news = node, news
        self._said: dict[str, tuple[float, str]] = {}
        self._standing: set[str] = set()
        self._logged = -math.inf
        self.counts: Counter[str] = Counter()

    def guarded(self, part: str, callback: Callable[[Any], None]) -> Callable[[Any], None]:
        """The callback, with what it refuses said and counted."""

        def guarded(message: Any) -> None:
            try:
                callback(message)
                self._standing.discard(part)
            except ModcalError as error:
                self.refuse(part, str(error))
                self._standing.add(part)

        return guarded

    def standing(self, *parts: str) -> str:
        """What the last message of these parts was refused for; nothing where it was taken, or was long ago."""
        return self.recent(*refused) if (refused := self._standing.intersection(parts)) else ""

    def refuse(self, part: str, said: str) -> None:
        """Say and count a refusal."""
        self.counts[part] += 1
        news, now = not self.recent(part), time.monotonic()
        self._said[part] = now, said
        # rclpy's own throttle looks up the caller first, which takes a millisecond: one that refuses everything would
        # fall behind, and refuse what it hears for being late
        if now - self._logged >= _REFUSALS_THROTTLE:
            self._logged = now
            self._node.get_logger().warning(said)
        if news:
            self._news()

    def recent(self, *parts: str) -> str:
        """What was refused of late of these parts, or of all; nothing if nothing was."""
        since = time.monotonic() - _SAID_FOR
        return "; ".join(said for part, (at, said) in self._said.items() if at >= since and part in (parts or [part]))
