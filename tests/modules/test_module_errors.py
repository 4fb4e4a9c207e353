"""Errors that belong to a module are found again in the next assembly; the truth is a workshop of moved frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import yaml
from cells import samples_of
from modules.arms import LIBRARY
from modules.workshop import Arm, Made, shelf_of

from modcal_core.calibration.cell import Cell, fit_cell
from modcal_core.errors import BadRecording, BadTable, NotEnoughData
from modcal_core.geometry import se3
from modcal_core.measurements.samples import Samples
from modcal_core.modules.errors import (
    ModuleErrors,
    RecordingEvidence,
    learn,
    part_std,
    recording_evidence,
    store_from_data,
    store_to_data,
    surprise,
    twists_from_data,
    with_recording,
)
from modcal_core.modules.library import Assembly, Module, chain_of

# One set of ten modules: a base, four joints, four links, a gripper.
JOINTS = [Module("JR", serial=f"J{k}") for k in range(1, 5)]
LINKS = [
    Module("LR-I", 4, serial="R1"),
    Module("LP", 3, serial="P1"),
    Module("LR-II", 2, serial="R2"),
    Module("LP", 5, serial="P2"),
]
TEN = [Module("B", 2, serial="B1"), *JOINTS, *LINKS, Module("G", serial="G1")]


def built(name: str, joints: list[int], links: list[int], turns: list[int]) -> Assembly:
    """All ten modules, joints and links in these orders, turned so."""
    inner = [m for j, k in zip(joints, links, strict=True) for m in (JOINTS[j], LINKS[k])]
    modules = (TEN[0], *(replace(m, turn=t) for m, t in zip([*inner, TEN[-1]], turns, strict=True)))
    return Assembly(modules, name).checked(LIBRARY)


THREE = [
    built("one", [0, 1, 2, 3], [0, 1, 2, 3], [0, 1, 0, 2, 0, 2, 0, 1, 0]),
    built("two", [3, 2, 0, 1], [2, 3, 0, 1], [0, 0, 2, 0, 1, 0, 3, 1, 0]),
    built("three", [3, 0, 2, 1], [0, 3, 1, 2], [1, 0, 0, 1, 2, 0, 1, 0, 0]),
]


def measured(assembly: Assembly, arm: Arm, rng: np.random.Generator, count: int = 80) -> Samples:
    q = rng.uniform(-2.0, 2.0, (count, assembly.n))
    return samples_of(chain_of(assembly, LIBRARY), q, se3.transform(p=arm.readings(q, rng)), kind="point")


def before_calibration(assembly: Assembly, errors: dict | None, samples: Samples) -> float:
    """Mean error on half of the stations, once base and ball have been located with the other half [m]."""
    half = len(samples) // 2
    first, rest = samples.select(np.arange(half)), samples.select(np.arange(half, len(samples)))
    model = fit_cell(chain_of(assembly, LIBRARY, errors), first, Cell()).model
    return float(np.linalg.norm(model.predict(rest.q)[:, :3, 3] - rest.reading, axis=1).mean())


def story(seed: int) -> tuple[float, float, list[RecordingEvidence]]:
    """Error of the third assembly before its own calibration, without and with the store, and what each told."""
    rng, made = np.random.default_rng(seed), Made()
    shelf = shelf_of(TEN, made, rng)
    told: list[RecordingEvidence] = []
    for assembly in THREE:
        samples = measured(assembly, Arm(assembly, shelf, made, rng), rng)
        if len(told) == 2:
            errors = learn(told, LIBRARY).twists
            without, with_store = (before_calibration(assembly, e, samples) for e in (None, errors))
        told.append(recording_evidence(assembly, LIBRARY, samples))
    return without, with_store, told


@pytest.fixture(scope="module")
def stories() -> list[tuple[float, float, list[RecordingEvidence]]]:
    return [story(seed) for seed in range(8)]


@pytest.mark.slow
def test_a_third_assembly_starts_better_than_its_drawing(
    stories: list[tuple[float, float, list[RecordingEvidence]]],
) -> None:
    """Eight workshops, ten modules each, two assemblies measured; the third was never seen."""
    without, with_store = np.array([[a, b] for a, b, _ in stories]).T
    assert with_store.mean() < 0.7 * without.mean()
    assert (with_store < without).sum() >= 7


def test_the_uncertainty_is_as_large_as_it_says(stories: list[tuple[float, float, list[RecordingEvidence]]]) -> None:
    """χ² of the third assembly about what the first two made expect, over all workshops."""
    found = [surprise(learn(told[:2], LIBRARY), told[2], LIBRARY) for _, _, told in stories]
    freedom = sum(s.freedom for s in found)
    assert [s.freedom for s in found] == [4 * 4 + 3 - 6 - 3] * len(found)  # what is left beside base and ball
    assert 0.6 * freedom < sum(s.chi2 for s in found) < 1.5 * freedom
    assert min(s.p_value for s in found) > 1e-3


def test_knowledge_grows_and_every_part_has_a_covariance(
    stories: list[tuple[float, float, list[RecordingEvidence]]],
) -> None:
    told = stories[0][2]
    one, two, three = (learn(told[:k], LIBRARY) for k in (1, 2, 3))
    for key, part in three.parts.items():
        assert np.linalg.eigvalsh(part.covariance).min() > 0.0
        prior = part_std(LIBRARY.module, key[1])
        assert (part.std <= prior * (1 + 1e-9)).all()
        for fewer in (one, two):
            if key in fewer.parts:
                assert (part.std <= fewer.parts[key].std * (1 + 1e-9)).all()
    assert {s for s, _ in three.parts} == {m.serial for m in (*JOINTS, *LINKS)}
    assert three.parts["P1", "whole"].seen == 2  # it was the last link of the second: one with the ball's place
    order = learn(told[::-1], LIBRARY)
    for key, part in three.parts.items():
        assert np.abs(order.parts[key].twist - part.twist).max() < 1e-9


def test_a_module_that_was_bent_is_noticed(stories: list[tuple[float, float, list[RecordingEvidence]]]) -> None:
    told = stories[1][2]
    known = learn(told[:2], LIBRARY)
    bent = told[2].deviation.copy()
    bent[1, 3] += 0.012
    assert surprise(known, told[2], LIBRARY).p_value > 1e-3
    assert surprise(known, replace(told[2], deviation=bent), LIBRARY).p_value < 1e-6


def test_what_one_assembly_cannot_tell_is_shared_by_prior_variance(rng: np.random.Generator) -> None:
    """Two joints and a link between them: error seen times the share of its variance, as a textbook has it."""
    assembly = Assembly(
        (Module("B"), Module("JR"), Module("LC", 3, serial="C1"), Module("JR"), Module("LC"), Module("G"))
    ).checked(LIBRARY)
    seen = np.array([0.0, 0.0, 4e-4, 0.0, 0.0, 0.0])  # along the axes, where no lever arm mixes anything
    known = learn([RecordingEvidence(assembly, seen[None], 1e16 * np.eye(6), 100, 0.0)], LIBRARY)
    module, bolt = LIBRARY.module.length**2, LIBRARY.interface.length**2
    share = module / (3 * module + 2 * bolt)  # the link, what the two joints have on either side, two pairs of flanges
    assert known.parts["C1", "whole"].twist[2] == pytest.approx(4e-4 * share, rel=1e-6)
    assert known.parts["C1", "whole"].std[2] == pytest.approx(np.sqrt(module * (1 - share)), rel=1e-6)


def test_the_store_keeps_everything(stories: list[tuple[float, float, list[RecordingEvidence]]]) -> None:
    known = learn(stories[2][2][:2], LIBRARY)
    data = yaml.safe_load(yaml.safe_dump(store_to_data(known, LIBRARY)))
    again = store_from_data(data, LIBRARY, "store.yaml")
    assert again.keys == known.keys
    assert all(np.array_equal(again.twists[key], known.twists[key]) for key in known.keys)
    assert np.array_equal(again.covariance, known.covariance)
    stated = twists_from_data(data, "store.yaml")
    assert stated.keys() == known.parts.keys()
    assert all(np.array_equal(stated[key], known.parts[key].twist) for key in stated)
    # one more, at once or after a rest
    third = stories[2][2][2]
    one, all_ = with_recording(again, third, LIBRARY).twists, learn(stories[2][2], LIBRARY).twists
    assert all(np.abs(one[key] - all_[key]).max() < 1e-15 for key in all_)
    assert len(with_recording(again, again.recordings[0], LIBRARY).recordings) == 2
    with pytest.raises(BadTable, match="is a different assembly"):
        with_recording(again, replace(third, assembly=replace(third.assembly, name="one")), LIBRARY)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"library": "another"}, "are of the library 'another'"),
        ({"assemblies": {}}, "assemblies: {} is not a list"),
        ({"assemblies": [{"modcal_assembly": 1}]}, "assemblies, entry 1: 'stations' is not stated"),
    ],
)
def test_a_store_that_is_none_is_refused(change: dict, words: str) -> None:
    data = store_to_data(ModuleErrors(), LIBRARY)
    with pytest.raises(BadTable) as refusal:
        store_from_data({**data, **change}, LIBRARY, "store.yaml")
    assert words in str(refusal.value)


def test_refusals(stories: list[tuple[float, float, list[RecordingEvidence]]], rng: np.random.Generator) -> None:
    stored = store_to_data(ModuleErrors(), LIBRARY)
    with pytest.raises(BadTable, match="modules: J1: 3 is not a mapping"):
        twists_from_data({**stored, "modules": {"J1": 3}}, "store.yaml")
    with pytest.raises(BadTable, match="mean: it has 1 entries, 6 are allowed"):
        twists_from_data({**stored, "modules": {"J1": {"parts": {"whole": {"mean": [1]}}}}}, "store.yaml")
    one = stories[0][2][0]
    longer = [replace(m, size=7) if m.serial == "P1" else m for m in one.assembly.modules]
    with pytest.raises(BadTable, match="serial number P1: is LP of length 7"):
        learn([one, replace(one, assembly=Assembly(tuple(longer), "other"))], LIBRARY)
    single = Assembly((Module("B"), Module("JR"), Module("LC"), Module("G"))).checked(LIBRARY)
    with pytest.raises(NotEnoughData, match="it has one joint"):
        recording_evidence(
            single,
            LIBRARY,
            samples_of(chain_of(single, LIBRARY), rng.uniform(-1, 1, (30, 1)), np.tile(np.eye(4), (30, 1, 1))),
        )


@pytest.mark.slow
def test_a_recording_of_another_assembly_teaches_nothing(rng: np.random.Generator) -> None:
    """A turn that was written down wrongly is refused; a length that was, is noticed."""
    made = Made()
    shelf = shelf_of(TEN, made, rng)
    samples = measured(THREE[0], Arm(THREE[0], shelf, made, rng), rng)

    def told(module: int, **change: int) -> RecordingEvidence:
        modules = [replace(m, **change) if i == module else m for i, m in enumerate(THREE[0].modules)]
        return recording_evidence(Assembly(tuple(modules), "wrong"), LIBRARY, samples)

    for turn in (0, 3):  # it is 2
        with pytest.raises(BadRecording):
            told(4, turn=turn)
    assert surprise(ModuleErrors(), told(4, size=3), LIBRARY).p_value > 1e-5  # as it is
    assert surprise(ModuleErrors(), told(4, size=5), LIBRARY).p_value < 1e-6  # 10 mm longer than it is
    other = replace(THREE[0], modules=tuple(replace(m, size=7) if m.serial == "P1" else m for m in THREE[0].modules))
    with pytest.raises(
        BadRecording, match="between joint_2 and joint_3 the recording differs from it by (19|20|21) mm"
    ):
        recording_evidence(replace(other, name="longer"), LIBRARY, samples)
