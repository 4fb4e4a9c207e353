"""The benchmark of the verdict is honest: its recordings hold what they say, and its judge accepts the truth only."""

from __future__ import annotations

import importlib
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from modcal_msgs_py.mcap_read import read_recording

FOLDER = Path(__file__).resolve().parents[2] / "bench" / "verdict"
OTHERS = ("arms", "sites", "harness", "scenarios", "recordings")


@pytest.fixture(scope="module")
def bench() -> Iterator[dict[str, ModuleType]]:
    before, known = list(sys.path), set(sys.modules)
    sys.path[:0] = [str(FOLDER), str(FOLDER.parent), str(FOLDER.parent / "undeclared")]
    names = sorted(p.stem for p in FOLDER.glob("*.py") if p.stem != "run")
    yield {name: importlib.import_module(name) for name in [*names, "run", "sites"]}
    sys.path[:] = before
    for name in set(sys.modules) - known:
        if name in {*names, "run", *OTHERS} or name.split(".")[0] == "kinds":
            sys.modules.pop(name)


def case(bench: dict[str, ModuleType], name: str, robot: str = "ur10", seed: int = 0) -> Any:
    rng = np.random.default_rng(seed)
    rows = {k: row for group in bench["case"].KINDS.values() for k, row in group.items()}
    return rows[name](bench["sites"].Cell(robot, rng), rng)


@pytest.mark.slow
def test_there_are_as_many_as_promised(bench: dict[str, ModuleType]) -> None:
    tasks = bench["run"].tasks_of(["main", "good"], [], None)
    assert sum(t["group"] == "main" for t in tasks) >= 100
    assert sum(t["group"] == "good" and t["way"] == "unknown" for t in tasks) >= 100
    assert sum(t["group"] == "good" and t["way"] != "unknown" for t in tasks) >= 100


@pytest.mark.slow
def test_every_kind_can_be_made_and_names_what_is_wrong(bench: dict[str, ModuleType]) -> None:
    for group in ("main", "later", "good"):
        for name in bench["case"].KINDS[group]:
            made = case(bench, name, "panda")
            assert made.fault == (group != "good"), name
            assert made.steps, name
            for session in made.sessions.values():
                assert len({len(session), len(session.q), len(session.raw()), len(session.again)}) == 1, name
                assert np.isfinite(session.raw()).all(), name
            assert not any(re.search(word, joint) for word in made.must_not for joint in meant(made)), name
            assert bench["case"].KINDS[group][name].says, name


def test_a_clean_recording_misses_mujoco_by_its_floor_only(bench: dict[str, ModuleType]) -> None:
    works = bench["sites"].Cell("xarm7", np.random.default_rng(3))
    session = works.clean(60)
    p, R = works.arm.frames(works.arm.coordinates(session.q))
    tool = p[:, -1] + np.einsum("mij,j->mi", R[:, -1], works.tool[0])
    seen = works.tracker[1].inv().apply(tool - works.tracker[0])
    off = 1e3 * np.sqrt(np.mean(np.sum((session.p - seen) ** 2, axis=1)))
    assert off == pytest.approx(session.floor_mm, rel=1e-6)
    arm_mm, _, eye_mm, _ = session.stated
    assert session.floor_mm == pytest.approx(np.hypot(arm_mm, eye_mm), rel=0.2)


@pytest.mark.slow
def test_faults_are_where_they_are_said_to_be(bench: dict[str, ModuleType], tmp_path: Path) -> None:
    turned = case(bench, "quaternion_w_first").judged
    assert np.allclose(turned.raw()[:, 3:], turned.R.as_quat()[:, [3, 0, 1, 2]])
    part = case(bench, "millimetres_in_a_part").judged
    far = np.linalg.norm(part.p, axis=1) > 100.0
    assert 0 < far.sum() < len(part)
    assert far[-1]
    assert not far[0]
    lost = case(bench, "joint_states_stale").judged
    same = (np.diff(lost.q, axis=0) == 0.0).all(axis=1)
    assert same.sum() == 24
    assert (np.diff(lost.p, axis=0) != 0.0).all()
    two = case(bench, "two_arms").judged
    assert [name for name in two.more if name.startswith("left_")]
    heavy = case(bench, "centre_of_mass_far_off").judged
    assert "500.0" in heavy.urdf
    bag = case(bench, "clean_dwells").judged.write(tmp_path / "bag")
    assert len(read_recording(bag).readings[0].stamps) == 100 * 15


def meant(made: Any) -> list[str]:
    """Joints that the true words of a fault name."""
    return [n for n in made.judged.names if made.fault and any(re.search(word, n, re.I) for word in made.must_name)]


def test_what_is_named_falsely_is_counted_beside_the_outcome(bench: dict[str, ModuleType]) -> None:
    judge, made = bench["judge"], case(bench, "three_tools")
    effect = {"family": "gear_harmonic", "place": made.judged.names[2], "driver": f"position:{made.judged.names[2]}"}
    regime = {"regimes": [{"from_station": 0, "to_station": 11, "what": "tool"}]}

    def named(made: Any, **more: Any) -> tuple[str, int]:
        said = judge._reported(made, report("open", final=3.0, **more), True)
        return said.outcome, len(said.false)

    assert named(made, open_because=["another tool"]) == (judge.NAMED, 0)
    assert named(made, **regime, effects=[effect]) == (judge.NAMED, 1)
    assert named(made, effects=[effect, effect | {"place": "tool"}]) == (judge.NAMED, 1)
    assert named(made, effects=[effect | {"family": "outliers"}]) == (judge.UNNAMED, 0)
    assert named(made, convention=f"{made.judged.names[0]} reversed") == (judge.UNNAMED, 1)
    assert len(judge._refused(made, f"modcal: bag: {made.judged.names[0]} is reversed").false) == 1
    assert not judge._refused(made, f"modcal: bag: the tool moved as {made.judged.names[0]} does").false
    springs = {"family": "compliance", "place": made.judged.names[1], "driver": f"load:{made.judged.names[1]}"}
    assert named(case(bench, "frozen_elastic"), effects=[springs]) == (judge.OPEN, 0)
    assert named(case(bench, "frozen_elastic"), effects=[springs, effect]) == (judge.OPEN, 1)
    assert named(case(bench, "frozen_again"), effects=[springs]) == (judge.OPEN, 1)


def report(status: str, verdict: str = "", final: float = 0.035, **more: Any) -> dict[str, Any]:
    errors = {"final": {"rms": final}}
    return {"status": status, "verdict": verdict, "error_mm": errors, "open_because": [], **more}


def test_what_the_judge_accepts(bench: dict[str, ModuleType]) -> None:
    judge, made = bench["judge"], case(bench, "first_twelve_with_another_tool")
    floor = made.judged.floor_mm

    def outcome(*arguments: Any, **more: Any) -> str:
        return judge._reported(made, report(*arguments, **more), None).outcome

    regime = {"regimes": [{"from_station": 0, "to_station": 11, "what": "tool"}]}
    assert outcome("at_floor", final=floor) == judge.CALM_AND_WRONG
    assert outcome("at_floor", final=floor, **regime) == judge.FOUND
    assert outcome("at_floor", final=2.0 * floor, **regime) == judge.CALM_AND_WRONG
    assert outcome("at_floor", final=floor, rejected_rms_mm={"with": 3.0}, **regime) == judge.CALM_AND_WRONG
    assert outcome("open", final=3.0) == judge.UNNAMED
    assert outcome("open", final=3.0, open_because=["12 stations need another tool"]) == judge.NAMED
    assert outcome("cannot_tell", "nothing in what is left stands out from noise") == judge.CALM_AND_WRONG
    assert outcome("cannot_tell", "no floor is known") == judge.SILENT
    assert judge._refused(made, "modcal: bag: the tool moved").outcome == judge.NAMED
    assert judge._refused(made, "modcal: bag: broken").outcome == judge.UNNAMED
    assert (
        judge._refused(made, "modcal: bag: broken: check that --base, tool and clocks agree").outcome == judge.UNNAMED
    )
    outliers = [{"family": "outliers", "place": "tool", "driver": "constant"}]
    assert outcome("open", final=3.0, effects=outliers) == judge.UNNAMED
    fine = case(bench, "clean_poses")
    for known in (True, False):
        said = judge._reported(fine, report("at_floor"), known).outcome
        assert said == (judge.AT_FLOOR if known else judge.BESIDE)
    assert judge._reported(fine, report("open"), True).outcome == judge.OPEN


def test_a_floor_is_stated_or_left_out(bench: dict[str, ModuleType]) -> None:
    judge, made = bench["judge"], case(bench, "frozen_again")
    stated = judge.variant(made, "stated")
    assert not any(s.again.any() for s in stated.sessions.values())
    assert "--repeatability-mm" in stated.steps[-1]
    assert "--repeatability-mm" not in stated.steps[0]
    unknown = judge.variant(made, "unknown")
    assert unknown.steps == made.steps
    assert json.dumps([list(step) for step in unknown.steps])
    assert not unknown.judged.again.any()
