"""The nodes of a cell: one node that only listens to them, and a snapshot of what it received, as plain data."""

from __future__ import annotations

import math
import os
import time
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.context import Context
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text
from std_msgs.msg import Bool, Float64

from modcal_msgs_py import seconds
from modcal_nodes.ros import FRESH, LATCHED, interface

LEVELS = ("ok", "warn", "error", "silent")
OURS = "modcal"  # the hardware id of every status of ours
_SILENT = 5.0  # s without a word after which a node counts as silent
_SHOWN = 5  # parameters of the running estimate
_DELAYS = 200  # poses whose delay is remembered

# What nodes publish beside /diagnostics, below their own name, and what a snapshot calls it
NUMBERS = {"residual": "residual_m", "residual_before": "residual_before_m", "trusted": "trusted"}
CHANGE, ESTIMATE, POSE = "change", "estimate", "pose"


@dataclass
class _Node:
    parts: dict[str, dict[str, Any]] = field(default_factory=dict)  # as in a snapshot
    heard: float = -math.inf
    values: dict[str, Any] = field(default_factory=dict)
    delays: deque[float] = field(default_factory=lambda: deque(maxlen=_DELAYS))


class Heard:
    """Everything that the nodes below a namespace published. Times are of one steady clock [s]."""

    def __init__(self, namespace: str = "") -> None:
        """namespace: only nodes below it are listened to; empty: all."""
        self._below = f"/{namespace.strip('/')}/" if namespace.strip("/") else "/"
        self._nodes: dict[str, _Node] = {}

    @property
    def names(self) -> tuple[str, ...]:
        """Full names of the nodes that were received."""
        return tuple(sorted(self._nodes))

    def status(self, name: str, hardware: str, level: int, message: str, facts: Mapping[str, str], at: float) -> None:
        """Take one status of /diagnostics; those of others are passed over."""
        node, _, part = name.partition(": ")
        if hardware == OURS and part and node.startswith(self._below):
            own, word = self._nodes.setdefault(node, _Node()), LEVELS[min(max(level, 0), 2)]
            own.parts[part] = {"part": part, "level": word, "message": message, "facts": dict(facts)}
            own.heard = max(own.heard, at)

    def value(self, node: str, what: str, value: Any) -> None:
        """Take what a node has published under its own name: a number of NUMBERS, a Change, or an Estimate."""
        if node in self._nodes:
            self._nodes[node].values[what] = value

    def pose(self, node: str, delay: float, deviation: float) -> None:
        """Take a corrected pose: how old it was when it came [s], and its largest standard deviation [m]."""
        if node in self._nodes and math.isfinite(delay) and math.isfinite(deviation):
            self._nodes[node].delays.append(delay)
            self._nodes[node].values[POSE] = deviation

    def snapshot(self, now: float) -> dict[str, Any]:
        """All that is known, as data for JSON: no number in it is other than finite."""
        nodes = [_node_data(name, node, now) for name, node in sorted(self._nodes.items())]
        worst = max((LEVELS.index(n["level"]) for n in nodes), default=0)
        return {"modcal_watch": 1, "level": LEVELS[worst], "nodes": nodes}


def _node_data(name: str, node: _Node, now: float) -> dict[str, Any]:
    age, parts = now - node.heard, list(node.parts.values())
    level = max((part["level"] for part in parts), key=LEVELS.index) if age < _SILENT else "silent"
    out: dict[str, Any] = {"name": name, "level": level, "heard_s_ago": round(max(age, 0.0), 2), "parts": parts}
    values = node.values
    for what in NUMBERS.values():
        if what in values and math.isfinite(values[what]):
            out[what] = values[what]
    if CHANGE in values:
        out["change"] = _change(values[CHANGE])
    if ESTIMATE in values and (estimate := _estimate(values[ESTIMATE])):
        out["estimate"] = estimate
    if node.delays:
        out["delay_ms"] = {
            "median": round(1e3 * float(np.median(node.delays)), 3),
            "p99": round(1e3 * float(np.percentile(node.delays, 99)), 3),
        }
        out["position_std_m"] = values[POSE]
    return out


def _change(message: Any) -> dict[str, Any] | None:
    """What has changed since the model was trusted; None for nothing."""
    if not message.changed:
        return None
    words = {name: getattr(message, name) for name in ("place", "direction", "driver", "sentence")}
    size = 1e3 * message.size_m if math.isfinite(message.size_m) else None
    return {**words, "since_s": seconds(message.since), "size_mm": size, "same_as": list(message.same_as)}


def _estimate(message: Any) -> list[dict[str, Any]]:
    """The parameters that stand off the trusted model by most of their standard deviations, those first."""
    names, value, std = message.names, np.asarray(message.values), np.asarray(message.stds)
    if not len(names) == len(value) == len(std):
        return []
    use = np.isfinite(value) & np.isfinite(std) & (std > 0.0)
    order = np.argsort(-np.abs(np.where(use, value, 0.0)) / np.where(use, std, 1.0), kind="stable")
    return [{"name": names[i], "value": float(value[i]), "std": float(std[i])} for i in order[:_SHOWN] if use[i]]


# --- A snapshot for a person: a table of what every node says, and a line for a log when that gets better or worse

_STYLES = {"ok": "green", "warn": "yellow", "error": "bold red", "silent": "bold magenta"}
# Facts that are worth a place in the table, by the words they begin with
_FACTS = (
    "state", "status", "claim p95", "apply", "solving", "largest sign", "samples rejected",
    "compute of an update, p99", "from stamp to update, p99",
    "candidate", "kind", "trusted", "probability", "ahead_m", "off_m", "poses", "commands", "refused", "phase",
    "force", "tick", "model", "lag",
    "messages", "bytes waiting", "free", "minutes until", "lost", "stations", "residual", "published", "effects",
)  # fmt: skip
_NOT = ("messages of", "messages refused", "publishers of", "bytes of", "rate of", "lost of")
_MAX = 8  # facts of one part


def table(snapshot: dict[str, Any]) -> RenderableType:
    """What every node says: level, message and the facts that matter, with what else it published below."""
    out = Table(box=None, header_style="bold", pad_edge=False, expand=True)
    for name, width in (("node", 24), ("level", 6), ("part", 12)):
        out.add_column(name, no_wrap=True, min_width=min(width, 10), max_width=width, overflow="ellipsis")
    out.add_column("says", ratio=1, overflow="fold")
    for node in snapshot["nodes"]:
        first, silent = node["name"], node["level"] == "silent"
        for part in node["parts"]:
            level = "silent" if silent else part["level"]
            said = f"silent for {node['heard_s_ago']:.0f} s; then: {part['message']}" if silent else part["message"]
            facts = ", ".join(_facts(part["facts"]))
            words = Text(said, style="" if level == "ok" else _STYLES[level])
            out.add_row(Text(first), Text(level, style=_STYLES[level]), Text(part["part"]), words)
            if facts:
                out.add_row("", "", "", Text(facts, style="dim"))
            first = ""
        for line in _beside(node):
            out.add_row("", "", "", Text(line, style="cyan"))
    title = Text("modcal watch  ") + Text(snapshot["level"], style=_STYLES[snapshot["level"]])
    return Group(title, out)


def _facts(facts: dict[str, str]) -> list[str]:
    wanted = [f"{k} {v}" for k, v in facts.items() if k.startswith(_FACTS) and not k.startswith(_NOT)]
    return wanted[:_MAX]


def _beside(node: dict[str, Any]) -> Iterator[str]:
    """What a node published beside /diagnostics, in words."""
    if "trusted" in node:
        yield "the model is trusted" if node["trusted"] else "the model is suspected: something has changed since"
    if "residual_m" in node:
        before = f", {1e3 * node['residual_before_m']:.4f} mm before" if "residual_before_m" in node else ""
        yield f"held-out residual {1e3 * node['residual_m']:.4f} mm{before}"
    if node.get("change"):
        yield f"change: {node['change'].get('sentence', 'unknown')}"
    if "estimate" in node:
        values = ", ".join(f"{p['name']} {p['value']:.3g} ± {p['std']:.2g}" for p in node["estimate"])
        yield f"running estimate, farthest off the trusted model [m, rad]: {values}"
    if "delay_ms" in node:
        delay, deviation = node["delay_ms"], 1e3 * node["position_std_m"]
        yield f"poses are {delay['median']:.1f} ms late (p99 {delay['p99']:.1f}); std {deviation:.3f} mm"


class Changes:
    """Lines for a log: one for each part whose level is not what it was."""

    def __init__(self) -> None:
        self._before: dict[tuple[str, str], str] = {}

    def lines(self, snapshot: dict[str, Any]) -> list[str]:
        """What has become better or worse since the last snapshot, and what is new."""
        out = []
        for node in snapshot["nodes"]:
            for part in node["parts"]:
                key = node["name"], part["part"]
                level = "silent" if node["level"] == "silent" else part["level"]
                if self._before.get(key) != level:
                    self._before[key] = level
                    out.append(f"{level}: {key[0]} {key[1]}: {part['message']}")
        return out


_QUEUE = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.VOLATILE)
_TYPES: dict[str, tuple[type, QoSProfile]] = {
    **{topic: (Float64, LATCHED) for topic in NUMBERS},
    "trusted": (Bool, LATCHED),
    POSE: (PoseWithCovarianceStamped, FRESH),
}


class Listener(Node):
    """Fills ``heard`` while it is spun."""

    def __init__(self, heard: Heard, context: Context) -> None:
        super().__init__(
            f"modcal_watch_{os.getpid()}", context=context, enable_rosout=False, start_parameter_services=False
        )
        self.heard = heard
        self._types = {**_TYPES, CHANGE: (interface("Change"), LATCHED), ESTIMATE: (interface("Estimate"), _QUEUE)}
        self._followed: set[str] = set()
        self.create_subscription(DiagnosticArray, "/diagnostics", self._take, _QUEUE)

    def _take(self, message: DiagnosticArray) -> None:
        now = time.monotonic()
        for s in message.status:
            facts = {pair.key: pair.value for pair in s.values}
            self.heard.status(s.name, s.hardware_id, int.from_bytes(s.level, "little"), s.message, facts, now)

    def follow(self) -> None:
        """Subscribe to what the nodes that were received publish beside /diagnostics, as soon as they do."""
        for node in self.heard.names:
            for what, (kind, qos) in self._types.items():
                topic = f"{node}/{what}"
                if topic not in self._followed and self.count_publishers(topic):
                    self._followed.add(topic)
                    self.create_subscription(kind, topic, partial(self._take_value, node, what), qos)

    def _take_value(self, node: str, what: str, message: Any) -> None:
        if what == POSE:
            variances = np.asarray(message.pose.covariance).reshape(6, 6).diagonal()[:3]
            now = 1e-9 * self.get_clock().now().nanoseconds
            deviation = float(np.sqrt(max(variances.max(), 0.0)))
            self.heard.pose(node, now - seconds(message.header.stamp), deviation)
        elif what in (CHANGE, ESTIMATE):
            self.heard.value(node, what, message)
        else:
            self.heard.value(node, NUMBERS[what], message.data)
