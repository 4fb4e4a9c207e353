"""A node that lives as long as a command of the shell."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from types import FrameType
from typing import Any, TypeVar

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

N = TypeVar("N", bound=Node)
MUTUAL = 0.5  # s: who was just found may not have found the finder, and what is sent then is lost


@contextmanager
def joined(make: Callable[[Context], N], domain: int | None = None) -> Iterator[tuple[N, SingleThreadedExecutor]]:
    """A node and its executor. make: such as :func:`passing`. domain: in place of ROS_DOMAIN_ID."""
    context = Context()
    rclpy.init(context=context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
    node = make(context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    try:
        yield node, executor
    finally:
        executor.shutdown(timeout_sec=1.0)
        node.destroy_node()
        rclpy.try_shutdown(context=context)


def passing(name: str) -> Callable[[Context], Node]:
    """Makes a bare node of this name and the process's number."""
    options = {"enable_rosout": False, "start_parameter_services": False}
    return lambda context: Node(f"{name}_{os.getpid()}", context=context, **options)


@contextmanager
def stopped_by(stop: Callable[[], None]) -> Iterator[None]:
    """SIGINT and SIGTERM call this while the block lasts."""

    def called(number: int, frame: FrameType | None) -> None:
        stop()

    before = {number: signal.signal(number, called) for number in (signal.SIGINT, signal.SIGTERM)}
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
