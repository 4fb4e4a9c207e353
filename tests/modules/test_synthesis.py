"""From a task to an arm: the published one in a few seeds, and everything between the task's file and the answer."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from modules.arms import LIBRARY, random_assembly

from modcal_core.errors import BadTable, NotReachable
from modcal_core.geometry import se3, so3
from modcal_core.modules import targets as reaching
from modcal_core.modules.coding import Coding
from modcal_core.modules.evaluation import Archive, Effort, Evaluator, SearchSettings, evolve
from modcal_core.modules.library import chain_of
from modcal_core.modules.requirements import REQUIREMENTS
from modcal_core.modules.synthesis import SynthesisTask, allowed, synthesize, task_from_data, to_data, to_markdown
from modcal_core.modules.targets import Target
from modcal_core.robots.kinematics import chain_forward

CODING = Coding(LIBRARY)
EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "synthesis" / "two_poses.yaml"
MASKS = ([1, 1, 1, 1, 1, 1], [1, 1, 0, 1, 1, 1], [0, 0, 1, 1, 1, 1], [0, 0, 0, 1, 1, 1])


def example(**changes: Any) -> SynthesisTask:
    return task_from_data({**yaml.safe_load(EXAMPLE.read_text()), **changes}, "two_poses.yaml")


def first_met(task: SynthesisTask, seed: int, joints: int = 5) -> Archive:
    """A search that ends with the first candidate that meets everything."""
    evaluator = Evaluator(LIBRARY, task.targets, task.uses, seed)
    rng = np.random.default_rng([seed, joints])
    return evolve(CODING, joints, evaluator, rng, SearchSettings(), enough=lambda a: bool(a.verdicts.met.any()))


# targets


@pytest.mark.parametrize("mask", MASKS)
def test_rows_are_zero_where_the_mask_is_met_and_only_there(mask: list[int], rng: np.random.Generator) -> None:
    goal = Target.build(so3.exp(rng.normal(size=3)), rng.normal(size=3), mask)
    A, b = goal.rows
    free = 1.0 - np.array(mask)
    turns = free[:3] * rng.uniform(-3.0, 3.0, 3) if free[:3].sum() != 2 else np.zeros(3)
    met = goal.T @ se3.transform(so3.exp(turns), free[3:] * rng.normal(size=3))
    assert np.abs(A @ met[:3].ravel() - b).max() < 1e-13
    assert max(goal.miss(met)) < 1e-7
    assert goal.error(met) == pytest.approx(np.zeros(6), abs=1e-13)
    for i in np.flatnonzero(mask):
        way, turn = np.zeros(3), np.zeros(3)
        (turn if i < 3 else way)[i % 3] = 1e-3
        left = np.linalg.norm(A @ (goal.T @ se3.transform(so3.exp(turn), way))[:3].ravel() - b)
        assert left == pytest.approx(1e-3, rel=1e-5)


def test_a_tool_upside_down_is_no_solution() -> None:
    """The printed measure of a half turn is zero; rows and miss are not taken in."""
    goal = Target.build(np.eye(3), np.zeros(3), [1, 1, 0, 1, 1, 1])
    upside_down = se3.transform(np.diag([1.0, -1.0, -1.0]))
    assert np.abs(goal.error(upside_down)).max() < 1e-15
    assert goal.miss(upside_down)[1] == pytest.approx(np.pi)
    A, b = goal.rows
    assert np.linalg.norm(A @ upside_down[:3].ravel() - b) == pytest.approx(2.0)


# inverse kinematics


@pytest.mark.slow
@pytest.mark.parametrize("mask", MASKS)
def test_poses_that_arms_are_in_are_reached(mask: list[int], rng: np.random.Generator) -> None:
    """Targets are taken from postures of the arms; what is said to be reached is, for the chain of the assembly."""
    reached = 0
    for _ in range(10):
        assembly = random_assembly(rng, 6)
        chain = chain_of(assembly, LIBRARY)
        arms = reaching.Arms.of([assembly], LIBRARY)
        T = chain_forward(chain, 0.8 * rng.uniform(chain.lower, chain.upper))
        goal = Target.build(T[:3, :3], T[:3, 3], mask)
        found = reaching.reach(arms, goal, arms.starts(rng.random((30, 6))), 60)
        good = found.left[0] < 1e-8
        assert (found.q[0] >= chain.lower - 1e-12).all()
        assert (found.q[0] <= chain.upper + 1e-12).all()
        for q in found.q[0, good]:
            assert np.abs(goal.error(chain_forward(chain, q))).max() < 2e-8
        reached += int(good.any())
    assert reached >= 9


# the search


@pytest.mark.slow
def test_the_published_task() -> None:
    """All 20 seeds are in bench/synthesis.py; two here."""
    task = example()
    assert task.first == 5
    for seed in (100, 101):
        archive = first_met(task, seed)
        i = archive.verdicts.order()[0]
        assert archive.verdicts.met[i]
        chain = chain_of(CODING.assembly(archive.genomes[i]), LIBRARY)
        T = chain_forward(chain, archive.verdicts.q[i])
        printed = np.array([[-0.3332, 0.2524, 0.9085], [0.1572, 0.5110, 0.8451]])
        assert np.abs(T[:, :3, 3] - [[-0.33, 0.25, 0.83], [0.2, 0.65, 0.65]]).max() < 1e-6
        z = printed / np.linalg.norm(printed, axis=1, keepdims=True)
        assert np.abs(T[:, :3, 2] - z).max() < 1e-6
        assert (np.abs(archive.verdicts.q[i]) <= chain.upper + 1e-12).all()
        assert len({g.tobytes() for g in archive.genomes}) == archive.judged


def near_task(**changes: Any) -> SynthesisTask:
    """Two positions that take an arm of three joints, quickly found."""
    targets = [{"position_m": p, "mask": "000111"} for p in ([0.3, 0.2, 0.4], [-0.25, 0.25, 0.45])]
    search = {"population": 48, "generations": 12, "patience": 2}
    data = {"modcal_synthesis": 1, "name": "near", "targets": targets, "search": search, "listed": 4}
    return task_from_data({**data, **changes}, "near.yaml")


@pytest.mark.slow
def test_fewest_joints_and_the_same_again_with_other_workers() -> None:
    task = near_task(joints={"first": 1, "last": 4}, requirements={"joint_range": {}, "payload": {"mass_kg": 0.5}})
    here = synthesize(task, LIBRARY, seed=3)
    assert [t.joints for t in here.tallies] == [1, 2, 3]
    assert [t.met_all > 0 for t in here.tallies] == [False, False, True]
    for tally in here.tallies:
        assert tally.judged == tally.met_all + sum(tally.rejected.values())
    costs = [c.cost for c in here.ranking]
    assert costs == sorted(costs)
    assert all(c.miss.max() < 1e-6 for c in here.ranking)
    others = synthesize(task, LIBRARY, seed=3, workers=2)
    assert to_data(here, LIBRARY) == to_data(others, LIBRARY)
    assert to_data(here, LIBRARY) != to_data(synthesize(task, LIBRARY, seed=4), LIBRARY)
    assert "Why others were rejected" in to_markdown(here, LIBRARY)


def test_a_requirement_rejects_and_says_so() -> None:
    """A sphere around a target leaves nothing; the reasons are counted."""
    sphere = {"center_m": [0.3, 0.2, 0.4], "radius_m": 0.1}
    task = near_task(joints={"first": 3, "last": 3}, requirements={"obstacles": {"spheres": [sphere]}})
    with pytest.raises(
        NotReachable, match=r"none of \d+ assemblies of 3 to 3 joints .*reachability \d+, obstacles \d+"
    ):
        synthesize(replace(task, settings=SearchSettings(48, 3)), LIBRARY)
    far = near_task(targets=[{"position_m": [0.0, 0.0, 5.0], "mask": "000111"}], joints={"first": 3, "last": 3})
    with pytest.raises(NotReachable, match="misses a target by") as refusal:
        synthesize(replace(far, settings=SearchSettings(48, 2)), LIBRARY)
    assert 3.0 < refusal.value.position < 5.0


def test_only_modules_that_are_allowed() -> None:
    task = near_task(modules=["JR", "LP", "LR-I"], requirements={"joint_range": {}})
    for candidate in synthesize(task, LIBRARY).ranking:
        assert {m.kind for m in candidate.assembly.modules} <= {"B", "JR", "LP", "LR-I", "G"}
    with pytest.raises(BadTable, match="no joint among them: add one of JR, JP"):
        allowed(LIBRARY, ("LP",))


# the task's file


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"modcal_synthesis": 2}, "modcal_synthesis: 2 is not one of 1"),
        ({"goals": []}, "unknown key goals"),
        ({"targets": []}, "targets: it has 0 entries"),
        ({"targets": [{"position_m": [300, 200, 400], "mask": "000111"}]}, "target 1: position_m: is 539 m away"),
        ({"targets": [{"position_m": [0, 0, 1], "mask": 111}]}, "mask 111: is not six"),
        ({"targets": [{"position_m": [0, 0, 1]}]}, "has 0 rotations"),
        ({"targets": [{"position_m": [0, 0, 1], "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 2]]}]}, "is not a rotation"),
        ({"targets": [{"position_m": [0, 0, 1], "z_axis": [0, 0, 1]}]}, "leaves the turn about z open"),
        ({"requirements": {"payloads": {}}}, "unknown key payloads; known are dexterity"),
        ({"requirements": {"payload": {}}}, "payload: 'mass_kg' is not stated"),
        ({"requirements": {"payload": {"mass_kg": -1}}}, "mass_kg: -1 is out of range"),
        ({"requirements": {"upright": {"hard": True}}}, "upright: unknown key hard"),
        ({"requirements": {"obstacles": {"spheres": [{"radius_m": 1}]}}}, "entry 1: 'center_m' is not stated"),
        ({"joints": {"first": 6, "last": 5}}, "joints: run from 6 to 5"),
        ({"search": {"population": 4}}, "population: 4 is out of range"),
        ({"name": "two poses"}, "is not a plain word"),
    ],
)
def test_tasks_that_cannot_be_used(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(BadTable) as refusal:
        example(**changes)
    assert words in str(refusal.value)
    assert str(refusal.value).startswith("two_poses.yaml")


def test_the_published_answer_turns_its_last_joint_for_nothing() -> None:
    """In this library: the frames in the modules are not printed. docs/synthesis.md says so."""
    genome = CODING.parse("00001 0·01·10·100·00 0·00·01·111·10 0·00·01·111·10 0·10·11·111·10 0·01·00·110·01")
    evaluator = Evaluator(LIBRARY, example().targets, example().uses, 0, Effort(starts=60, hopeless=np.inf))
    verdict = evaluator(genome[None])
    assert verdict.level[0] == 2
    assert verdict.amount[0] > 1e-3
    chain = chain_of(CODING.assembly(genome), LIBRARY)
    T = chain_forward(chain, np.array([[0.3, -0.2, 0.4, 0.9, 0.0], [0.3, -0.2, 0.4, 0.9, 1.2]]))
    assert np.abs(T[0, :3, 2:] - T[1, :3, 2:]).max() < 1e-15


def test_the_document(capsys: pytest.CaptureFixture[str]) -> None:
    """Its task can be read, its code runs, and its table names every requirement."""
    text = (EXAMPLE.parents[2] / "docs" / "synthesis.md").read_text()
    task = task_from_data(yaml.safe_load(re.findall(r"```yaml\n(.*?)```", text, re.DOTALL)[0]), "docs")
    assert [u.name for u in task.uses] == ["structure", "reachability", "joint_range", "payload"]
    exec(re.findall(r"```python\n(.*?)```", text, re.DOTALL)[0], {})
    assert "JR LR-II JR LC G" in capsys.readouterr().out
    assert set(re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE)) >= set(REQUIREMENTS)
