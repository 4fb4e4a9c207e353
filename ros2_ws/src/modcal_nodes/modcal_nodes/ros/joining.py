"""A node that lives as long as a command of the shell."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any, TypeVar

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

N = TypeVar("N", bound=Node)
MUTUAL = 0.5  # s: who was just found may not have found the finder, and what is sent then is lost


@contextmanager
def joined(make: Callable[[Context], N], domain: int | None = None) -> Iterator[tuple[N, Callable[[float], None]]]:
    """A node, and what spins it once for so many seconds at most. domain: in place of ROS_DOMAIN_ID."""
    context = Context()
    rclpy.init(context=context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
    node = make(context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    try:
        yield node, executor.spin_once
    finally:
        executor.shutdown(timeout_sec=1.0)
        node.destroy_node()
        rclpy.try_shutdown(context=context)


def passing(context: Context) -> Node:
    """A bare node of a name that no other has."""
    name = f"modcal_{os.getpid()}"
    return Node(name, context=context, enable_rosout=False, start_parameter_services=False)


@contextmanager
def stopped_by(stop: Callable[[], None]) -> Iterator[None]:
    """SIGINT and SIGTERM call this while the block lasts."""
    before = {number: signal.signal(number, lambda *_: stop()) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def interrupt() -> None:
    """Raise what Ctrl-C raises."""
    raise KeyboardInterrupt


def type_of(name: str) -> Any:
    """The class of a type such as ``std_srvs/srv/Trigger``; None where it is not installed."""
    module, _, kind = name.rpartition("/")
    try:
        return getattr(import_module(module.replace("/", ".")), kind, None)
    except (ImportError, ValueError):
        return None
