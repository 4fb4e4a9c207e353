"""What the running nodes open is what the page of topics lists, with its type; and no text stands for something else."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest
from nodes.processes import ROOT, Process, fresh_domain, listener, running
from rclpy.action.graph import get_action_client_names_and_types_by_node, get_action_server_names_and_types_by_node
from rclpy.node import Node, NodeNameNonExistentError

sys.path.insert(0, str(ROOT / "scripts" / "reference"))
import graph

PAGE = (ROOT / "docs" / "reference" / "topics.md").read_text()
# Texts that are meant as such: URDF, and advice to a person
TEXTS = {"robot_description", "~/robot_description", "object_description", "~/object_description", "~/coaching"}
LIFECYCLE = (
    "publishes",
    "~/transition_event",
    "lifecycle_msgs/msg/TransitionEvent",
)  # which rclpy itself does not tell
Opened = set[tuple[str, str, str]]  # kind, name and type


def listed(node: str) -> tuple[Opened, Opened]:
    """What a node always opens, by the page, and what some parameter decides."""
    always, sometimes = set(), set()
    text = re.split(r"^## ", PAGE, flags=re.MULTILINE)
    (section,) = [part for part in text if part.startswith(f"{node}\n")]
    for table in section.split("\n\n"):
        kind, *rows = [
            [cell.strip("` ") for cell in line.strip("|").split("|")] for line in table.splitlines() if "|" in line
        ] or [[""]]
        for row in rows[1:]:
            (sometimes if len(row) > 3 and row[3].strip() else always).add((kind[0], row[0].lstrip("/"), row[1]))
    return {one for one in always if one[0] in graph.KINDS}, sometimes


def opened(here: Node, node: str) -> Opened:
    """What the graph says of a node, in a namespace of its own."""
    space, found = f"/of_{node}", set()
    asked = {
        "publishes": here.get_publisher_names_and_types_by_node,
        "subscribes to": here.get_subscriber_names_and_types_by_node,
        "serves": here.get_service_names_and_types_by_node,
        "performs": lambda *of: get_action_server_names_and_types_by_node(here, *of),
        "asks for": lambda *of: get_action_client_names_and_types_by_node(here, *of),
    }
    for kind, ask in asked.items():
        for name, types in ask(node, space):
            if (
                name not in graph.EVERY_NODE
                and "/_action/" not in name
                and not types[0].startswith(graph.EVERY_NODES_SERVICES)
            ):
                short = name.removeprefix(f"{space}/").replace(f"{node}/", "~/", 1) if name.startswith(space) else name
                found.add((kind, short.lstrip("/"), types[0]))
    return found


@pytest.mark.dds
@pytest.mark.slow
def test_every_node_opens_what_the_page_lists(tmp_path: Path) -> None:
    domain, nodes = fresh_domain(), graph.executables()
    assert len(nodes) == 13
    given = {**graph.NEEDED, "impedance_setpoint": {"autostart": "true"}}
    started = [Process(n, domain, tmp_path, "-r", f"__ns:=/of_{n}", **given.get(n, {})) for n in nodes]
    with running(*started), listener(domain) as (here, wait):
        for node in nodes:
            always, sometimes = listed(node)

            def there(node: str = node, always: Opened = always) -> Opened:
                try:
                    return found if always <= (found := opened(here, node)) else set()
                except NodeNameNonExistentError:
                    return set()

            found = wait(there, 60.0)
            hears = {one for one in found if one[0] == "subscribes to"} if node == "recorder" else set()
            assert found - hears <= always | sometimes | {LIFECYCLE}, node
            assert {name for _, name, kind in found | sometimes if kind == "std_msgs/msg/String"} <= TEXTS, node
