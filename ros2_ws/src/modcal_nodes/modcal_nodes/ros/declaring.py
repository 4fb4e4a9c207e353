"""A node's parameters: declared with their bounds, read, and followed while it runs."""

from __future__ import annotations

from collections.abc import Callable
from difflib import get_close_matches
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter as Given

from modcal_core.errors import ModcalError
from modcal_nodes.ros.guarded import GuardedNode
from modcal_nodes.ros.parameters import NODES, Parameter


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


def follow(
    node: GuardedNode,
    parameters: dict[str, Parameter],
    chosen: dict[str, Any],
    check: Callable[[dict[str, Any]], object] = lambda new: None,
    take: Callable[[], object] = lambda: None,
) -> None:
    """Keep ``chosen`` as the parameters are while the node runs.

    check: raises ModcalError for values that cannot be, given all of them as they would be. take: called after a
    change.
    """

    def judge(changed: list[Any]) -> SetParametersResult:
        try:
            check({**chosen, **{p.name: p.value for p in changed if p.name in parameters}})
        except ModcalError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def apply(changed: list[Any]) -> None:
        chosen.update({p.name: p.value for p in changed if p.name in parameters})
        take()

    node.add_on_set_parameters_callback(judge)
    node.add_post_set_parameters_callback(apply)
