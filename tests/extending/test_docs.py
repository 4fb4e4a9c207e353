"""What docs/extending.md shows works as it stands there, and names what the example package registers."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from types import SimpleNamespace as Message

import numpy as np

from modcal_core.articulation.models.parametric import ParametricModel
from modcal_core.effects.family import Family
from modcal_msgs_py.topics import AddedTopic, Joints

ROOT = Path(__file__).resolve().parents[2]
TEXT = (ROOT / "docs" / "extending.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", TEXT, re.DOTALL)


def test_the_examples_run() -> None:
    effect, topic, moving = ({}, {}, {})  # type: tuple[dict[str, object], dict[str, object], dict[str, object]]
    for program, names in zip(blocks("python"), (effect, topic, moving), strict=True):
        exec(compile(program, "docs/extending.md", "exec"), names)
    assert isinstance(effect["FAMILY"], Family)
    added = topic["TOPIC"]
    assert isinstance(added, AddedTopic)
    (said,) = added.take(Message(data=[0.1] * 6))
    assert isinstance(said, Joints)
    assert said.name[5] == "joint_6"
    model = moving["MODEL"]
    assert isinstance(model, ParametricModel)
    _, T = model.checked_path(model.prior[0], 9)
    assert np.allclose(np.hypot(T[:, 0, 3], T[:, 1, 3]), 0.25)  # in the middle of the bar it is a circle


def test_the_entry_points_are_those_of_the_example() -> None:
    (text,) = blocks("toml")
    written = tomllib.loads(text)["project"]["entry-points"]
    package = tomllib.loads((ROOT / "examples" / "extending" / "pyproject.toml").read_text())
    assert written == package["project"]["entry-points"]
