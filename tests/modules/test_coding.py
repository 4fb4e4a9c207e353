"""The published code and the incidence matrix: written and read back they are the same arm, and each fault is named."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
import yaml
from modules.arms import LIBRARY, five_joints, random_assembly

from modcal_core.errors import BadTable
from modcal_core.modules.coding import Coding, assembly_from_data, assembly_to_data, matrix_of, matrix_text
from modcal_core.modules.library import Assembly, chain_of, library_from_data, published_text
from modcal_core.modules.targets import Catalogue
from modcal_core.modules.urdf import body

CODING = Coding(LIBRARY)
ANSWER = "00001 0·01·10·100·00 0·00·01·111·10 0·00·01·111·10 0·10·11·111·10 0·01·00·110·01"


def test_the_published_answer_decodes_as_printed() -> None:
    genome = CODING.parse(ANSWER)
    assert CODING.assembly(genome) == five_joints()
    assert CODING.text(CODING.genome(five_joints())) == ANSWER


def test_decoding_undoes_encoding(rng: np.random.Generator) -> None:
    for _ in range(200):
        assembly = random_assembly(rng)
        genome = CODING.genome(assembly)
        assert CODING.assembly(genome) == assembly
        assert np.array_equal(CODING.parse(CODING.text(genome)), genome)
        assert np.array_equal(CODING.parse(CODING.text(genome).replace("·", "")), genome)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "has no joint"),
        ("00001", "has no joint"),
        ("0001 0011010000", "code of the base '0001'"),
        ("00001 001101000", "code of joint 1 '001101000': is not 10 bits"),
        ("00001 00110100x0", "is not 10 bits"),
    ],
)
def test_what_is_no_code_is_refused(text: str, words: str) -> None:
    with pytest.raises(BadTable, match=words):
        CODING.parse(text)


def test_a_library_with_other_modules_has_its_own_genes() -> None:
    """A third kind of joint takes one more bit; a kind of link that is missing, or has one length, leaves holes."""
    data = yaml.safe_load(published_text())
    data["modules"]["JX"] = {"role": "joint", "motion": "revolute", "code": 2, "output": {"xyz": [0, 0, 0.2]}}
    data["modules"]["LP"]["length_m"] = {"first": 0.2, "step": 0.0}
    del data["modules"]["LR-II"]
    coding = Coding(library_from_data(data, "mine.yaml"))
    assert coding.shape == (4, 4, 4, 8, 4)
    joint, _, link, size, _ = coding.fields(np.arange(coding.genes))
    assert np.array_equal(coding.buildable, (joint < 3) & (link < 3) & ((link != 1) | (size == 0)))
    assembly = Assembly.build((1, 2), [("JX", 1, "LP", 0, 3)])
    assert coding.text(coding.genome(assembly)) == "00110 10·01·01·000·11"
    assert coding.assembly(coding.genome(assembly)) == assembly
    with pytest.raises(BadTable, match="no module has it"):
        coding.assembly(coding.parse("00110 11·01·01·000·11"))
    with pytest.raises(BadTable, match="length code is 1"):
        coding.assembly(coding.parse("00110 10·01·01·001·11"))
    Catalogue(coding)  # holes are no trouble


def test_tables_hold_the_same_arms(rng: np.random.Generator) -> None:
    catalogue = Catalogue(CODING)
    for n in range(1, 8):
        assemblies = [random_assembly(rng, n) for _ in range(10)]
        genomes = np.stack([CODING.genome(a) for a in assemblies])
        arms, bodies = catalogue.arms(genomes), catalogue.bodies(genomes)
        for i, assembly in enumerate(assemblies):
            chain = chain_of(assembly, LIBRARY)
            assert np.abs(arms.origins[i] - chain.origins).max() < 1e-15
            assert np.array_equal(arms.revolute[i], chain.revolute)
            assert np.array_equal([arms.lower[i], arms.upper[i]], [chain.lower, chain.upper])
            kinds = [(LIBRARY.types[m.kind], m.size) for m in assembly.modules[1:]]
            total = sum(body(*kind).mass for kind in kinds)
            assert bodies.mass[i].sum() == pytest.approx(total)


# A matrix of the paper's form: five revolute joints, and a kind of link (LC) that is not used.
AIM: dict[str, Any] = {
    "columns": ["JR", "JR", "JR", "JR", "JR", "G"],
    "rows": {
        "B": ["1,1,0", "", "", "", "", ""],
        "LC": ["", "", "", "", "", ""],
        "LR-I": ["1,1,0", "1,2,0", "", "2,4,2", "2,5,0", ""],
        "LR-II": ["", "", "1,3,0", "1,4,0", "2,5,2", "2,1,0"],
        "LP": ["", "1,2,0", "1,3,0", "", "", ""],
    },
}


def spec(**parts: Any) -> dict[str, Any]:
    return {"modcal_assembly": 1, **copy.deepcopy(parts)}


def test_a_matrix_is_read_as_the_arm_it_stands_for() -> None:
    sizes = {"LR-I": [4, 2], "LP": [7]}
    assembly = assembly_from_data(spec(aim={**AIM, "sizes": sizes}), LIBRARY, "spec")
    kinds = [(m.kind, m.size, m.turn) for m in assembly.modules]
    assert kinds == [
        ("B", 0, 0), ("JR", 0, 0), ("LR-I", 4, 0), ("JR", 0, 0), ("LP", 7, 0), ("JR", 0, 0), ("LR-II", 0, 0),
        ("JR", 0, 0), ("LR-I", 2, 2), ("JR", 0, 0), ("LR-II", 0, 2), ("G", 0, 0),
    ]  # fmt: skip


def test_the_matrix_of_the_published_answer() -> None:
    matrix = matrix_of(five_joints(), LIBRARY)
    assert matrix["columns"] == ["JR"] * 5 + ["G"]
    assert matrix["rows"]["B"][0] == "1,1,1"
    # between joints 2 and 3 and between 3 and 4 are parallel links: the column of joint 3 holds both in one cell
    assert matrix["rows"]["LP"][2] == "1,3,2 2,3,0"
    assert matrix["rows"]["LC"][5] == "1,1,1"
    assert "LP     ·      1,2,0  1,3,2 2,3,0  2,4,2" in matrix_text(matrix)


@pytest.mark.slow
@pytest.mark.parametrize("serials", [False, True])
def test_round_trip(serials: bool, rng: np.random.Generator) -> None:
    for _ in range(200):
        assembly = random_assembly(rng)
        if serials:
            count = len(assembly.modules)
            known = [f"S{k}" if rng.random() < 0.7 else "" for k in range(count)]
            assembly = assembly.with_serials(known)
        data = assembly_to_data(assembly, LIBRARY)
        assert assembly_from_data(data, LIBRARY, "written") == assembly
        for alone in ("modules", "aim"):
            part = {key: value for key, value in data.items() if key != {"modules": "aim", "aim": "modules"}[alone]}
            assert assembly_from_data(part, LIBRARY, alone) == assembly


def with_row(row: str, *cells: str) -> dict[str, Any]:
    matrix = copy.deepcopy(AIM)
    matrix["rows"][row] = list(cells)
    return matrix


FAULTS: list[tuple[dict[str, Any], str]] = [
    ({"columns": AIM["columns"]}, "aim: 'rows' is not stated"),
    ({**AIM, "colour": 1}, "aim: unknown key colour"),
    ({**AIM, "columns": ["JR"] * 6}, "it ends in a joint: end it in a gripper"),
    ({**AIM, "columns": ["LC", *["JR"] * 4, "G"]}, "module 2 (LC): a link stands after a base: use a joint here"),
    ({**AIM, "columns": ["JR", "G"]}, "row B: needs 2 cells"),
    (with_row("LC", "1,1", *[""] * 5), "row LC, column 1: '1,1': is not link,joint,turn"),
    ({**AIM, "rows": {"B": [[1, 1, 0]]}}, "rows: B, entry 1: [1, 1, 0] is not a text"),
    (with_row("B", *[""] * 6), "row B, column 1: holds nothing, the arm 1,1,0"),
    (with_row("B", "2,1,0", *[""] * 5), "row B, column 1: holds 2,1,0, the arm 1,1,0"),
    (with_row("LP", "", "1,3,0", "1,3,0", "", "", ""), "row LP, column 2: holds 1,3,0, the arm 1,2,0"),
    (with_row("LR-II", "", "", "1,3,0", "1,4,0", "2,5,2", "2,6,0"), "column 6: holds 2,6,0, the arm 2,1,0"),
    (with_row("LP", "", "1,2,4", "1,3,0", "", "", ""), "turned by 4 quarter turns"),
    (with_row("LP", "", "0,2,0", "0,3,0", "", "", ""), "row LP: has numbers 0: number them 1 to 1"),
    (with_row("LP", "", "1,2,0", "", "", "", ""), "0 links lead from column 2 to the next"),
    (with_row("LC", "", "1,2,0", "1,3,0", "", "", ""), "2 links lead from column 2 to the next"),
    ({**AIM, "sizes": {"LP": [7, 7]}}, "LP 2: is described but not in the matrix"),
    ({**AIM, "sizes": {"LP": [9]}}, "its length code is 9"),
    ({**AIM, "serials": {"LP": ["a"], "B": ["a"]}}, "serial number a is at module"),
]


@pytest.mark.parametrize(("matrix", "words"), FAULTS, ids=[words[:40] for _, words in FAULTS])
def test_every_fault_is_one_line(matrix: dict[str, Any], words: str) -> None:
    with pytest.raises(BadTable) as refusal:
        assembly_from_data(spec(aim=matrix), LIBRARY, "spec.yaml")
    assert words in str(refusal.value)
    assert str(refusal.value).startswith("spec.yaml")
    assert "\n" not in str(refusal.value)


MODULES: list[dict[str, Any]] = [
    {"module": "B"},
    {"module": "JR", "turn": 90},
    {"module": "LC", "length": 2},
    {"module": "G"},
]


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (None, "None is not a mapping"),
        (spec(), "names no modules"),
        (spec(modules=MODULES, joints=[]), "unknown key joints"),
        (spec(modules=[*MODULES[:3], "G"]), "entry 4: 'G' is not a mapping"),
        (spec(modules=[{"module": "B", "size": 1}]), "entry 1: unknown key size"),
        (spec(modules=[*MODULES[:1], {"module": "JR", "turn": 45}]), "entry 2: turn: 45 is not one of 0"),
        (spec(modules=MODULES, name="my arm"), "name 'my arm'"),
        (spec(modules=MODULES, aim=AIM), "modules and aim differ from module 2 on"),
    ],
)
def test_what_is_no_assembly_is_refused(data: Any, words: str) -> None:
    with pytest.raises(BadTable) as refusal:
        assembly_from_data(data, LIBRARY, "spec.yaml")
    assert words in str(refusal.value)
    assert str(refusal.value).startswith("spec.yaml")
