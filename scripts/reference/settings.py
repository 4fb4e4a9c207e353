"""The page of the nodes' parameters: type, default, bounds and meaning, as the nodes declare them."""

from __future__ import annotations

from typing import Any

from graph import executables
from markup import code, prose, table

from modcal_nodes.ros import parameters
from modcal_nodes.ros.parameters import Parameter

INTRODUCTION = """# Parameters of the nodes

A value outside its bounds is refused, with the reason, when the node starts. All of them have `use_sim_time` besides.
Those that are *live* may be changed while the node runs, and take effect; every other one is read-only.
What belongs together is explained in [nodes.md](../nodes.md); files to begin with are in the package's `config/`."""
TYPES = {bool: "bool", int: "integer", float: "double", str: "string"}


def page() -> str:
    """Text of the page."""
    parts = [INTRODUCTION]
    for node in executables():
        declared: dict[str, Parameter] = getattr(parameters, node.upper())
        rows = [
            (
                code(name),
                _type(p.default),
                code(_shown(p.default)),
                _bounds(p),
                "yes" if p.live else "",
                prose(p.description),
            )
            for name, p in declared.items()
        ]
        parts += [f"## {node}", table(("parameter", "type", "default", "bounds", "live", ""), rows)]
    return "\n\n".join(parts) + "\n"


def _type(default: Any) -> str:
    return f"{TYPES[type(default[0])]} array" if isinstance(default, list) else TYPES[type(default)]


def _shown(default: Any) -> str:
    """As it is written in a parameter file."""
    if isinstance(default, list):
        return "[" + ", ".join(map(_shown, default)) + "]"
    if isinstance(default, str):
        return f'"{default}"'
    return str(default).lower() if isinstance(default, bool) else repr(default)


def _bounds(parameter: Parameter) -> str:
    if parameter.low is None or parameter.high is None:
        return ""
    return f"{parameter.low:.10g} to {parameter.high:.10g}"
