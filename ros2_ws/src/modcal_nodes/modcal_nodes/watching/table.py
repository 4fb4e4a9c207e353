"""A snapshot for a person: a table of what every node says, and a line for a log when that gets better or worse."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

_STYLES = {"ok": "green", "warn": "yellow", "error": "bold red", "silent": "bold magenta"}
# Facts that are worth a place in the table, by the words they begin with
_FACTS = (
    "state", "status", "solving", "largest sign", "samples rejected",
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
