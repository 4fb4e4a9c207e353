"""Starting and stopping a node: the same for all of them."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from modcal_core.errors import ModcalError

LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# nothing is lost where the publisher can repeat it; one that cannot is heard as it is, see hearing.py
SENSOR = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.VOLATILE)
# what is acted on at once: a long queue would only make it old
FRESH = QoSProfile(depth=20, reliability=ReliabilityPolicy.BEST_EFFORT, durability=DurabilityPolicy.VOLATILE)


def run(make: Callable[[], Node], rest: float = 0.0) -> None:
    """Spin the node until it is told to stop (Ctrl-C, SIGTERM, shutdown), then close it.

    rest: seconds between two looks for messages. Each look costs as much as handling ten messages; a node that takes
    all that waits (see hearing.py) and need not answer within a millisecond gets by with few.

    A ModcalError, or a parameter outside its bounds, ends the process with exit code 2 and one line on stderr.
    """
    code = 0
    rclpy.init()
    node: Node | None = None
    try:
        node = make()
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        while rclpy.ok():
            executor.spin_once()
            if rest:
                time.sleep(rest)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except (ModcalError, ParameterException) as error:
        print(f"modcal: {' '.join(str(error).split())}", file=sys.stderr)
        code = 2
    except RuntimeError:
        # a signal may end the context between two looks at it; the wait for messages then finds it gone and raises
        # an error of rcl, which has no public name
        if rclpy.ok():
            raise
    finally:
        code = max(code, _close(node))
        rclpy.try_shutdown()
    sys.exit(code)


def _close(node: Node | None) -> int:
    if node is None:
        return 0
    try:
        if hasattr(node, "close"):
            node.close()
    except ModcalError as error:
        print(f"modcal: {error}", file=sys.stderr)
        return 2
    finally:
        node.destroy_node()
    return 0
