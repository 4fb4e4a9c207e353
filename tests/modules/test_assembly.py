"""From modules to a chain and a URDF; the published code and the incidence matrix; every fault is named."""

from __future__ import annotations

import copy
import re
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
import yaml
from modules.arms import LIBRARY, five_joints, numbered, random_assembly

from modcal_core.errors import BadTable
from modcal_core.geometry import se3
from modcal_core.modules.coding import Coding, assembly_from_data, assembly_to_data, matrix_of, matrix_text
from modcal_core.modules.library import Assembly, Module, chain_of, library_from_data, origins, published_text
from modcal_core.modules.urdf import body, urdf_of
from modcal_core.robots.kinematics import chain_forward
from modcal_core.robots.urdf import read_chain
from modcal_core.robots.urdf_inertias import read_inertias

PUBLISHED = yaml.safe_load(published_text())


def test_lengths_are_the_published_ones() -> None:
    def millimetres(kind: str) -> list[float]:
        return [round(1e3 * LIBRARY.type(kind).length(n), 9) for n in range(8)]

    for kind, first in (("B", 0.0), ("LC", 40.0), ("LP", 180.0), ("LR-I", 71.5), ("LR-II", 71.5)):
        assert millimetres(kind) == [first + 5.0 * n for n in range(8)]
    assert [t.name for t in LIBRARY.of_role("link")] == ["LC", "LP", "LR-I", "LR-II"]
    assert [t.name for t in LIBRARY.of_role("joint")] == ["JR", "JP"]


@pytest.mark.slow
def test_many_assemblies_against_pinocchio(rng: np.random.Generator) -> None:
    """Pinocchio reads the URDF, in which every module and every quarter turn stands by itself."""
    worst = 0.0
    for _ in range(100):
        assembly = random_assembly(rng)
        chain = chain_of(assembly, LIBRARY)
        model = pin.buildModelFromXML(urdf_of(assembly, LIBRARY))
        data = model.createData()
        order = [model.joints[model.getJointId(name)].idx_q for name in chain.names]
        q = rng.uniform(chain.lower, chain.upper)
        pin.framesForwardKinematics(model, data, q[np.argsort(order)])
        tip = data.oMf[model.getFrameId("tool0")].homogeneous
        worst = max(worst, float(np.abs(chain_forward(chain, q) - tip).max()))
        again = read_chain(urdf_of(assembly, LIBRARY))
        assert (again.base, again.tip, again.names) == (chain.base, chain.tip, chain.names)
        assert np.abs(again.origins - chain.origins).max() < 1e-15
        assert np.array_equal([again.lower, again.upper], [chain.lower, chain.upper])
    assert worst < 1e-12


def test_twists_as_printed(rng: np.random.Generator) -> None:
    """T_i multiplied out as the paper has it, its twists, and the product of their exponentials."""
    for _ in range(10):
        assembly = random_assembly(rng)
        chain = chain_of(assembly, LIBRARY)
        way = [LIBRARY.types[m.kind].T_in_out[m.size] for m in assembly.modules]
        turn = [se3.exp([0, 0, 0, 0, 0, 0.5 * np.pi * m.turn]) for m in assembly.modules]
        T = way[0] @ turn[1]
        frames = [T]
        for i in range(assembly.n):
            T = T @ way[1 + 2 * i] @ turn[2 + 2 * i] @ way[2 + 2 * i] @ turn[3 + 2 * i]
            frames.append(T)
        frames[-1] = T @ way[-1]
        steps = origins(assembly, LIBRARY)
        assert np.abs(np.stack(list(accumulate(steps, np.matmul))) - frames).max() < 1e-14
        w, p = np.stack(frames[:-1])[:, :3, 2], np.stack(frames[:-1])[:, :3, 3]
        xi = np.where(chain.revolute[:, None], np.c_[np.cross(p, w), w], np.c_[w, np.zeros_like(w)])
        assert np.abs(xi - chain.spatial_twists).max() < 1e-14
        q = rng.uniform(chain.lower, chain.upper)
        product = np.eye(4)
        for k in range(chain.n):
            product = product @ se3.exp(xi[k] * q[k])
        assert np.abs(product @ frames[-1] - chain_forward(chain, q)).max() < 1e-13


def test_known_errors_of_modules_travel_with_their_serial_numbers(rng: np.random.Generator) -> None:
    assembly = numbered(five_joints(), [f"S{k}" for k in range(12)])
    errors = {("S2", "whole"): 1e-3 * rng.normal(size=6), ("S3", "to_axis"): 1e-3 * rng.normal(size=6)}
    errors |= {("S3", "from_axis"): 1e-3 * rng.normal(size=6), ("elsewhere", "whole"): np.ones(6)}
    chain = chain_of(assembly, LIBRARY, errors)
    M = np.array(origins(assembly, LIBRARY))
    way, turn = LIBRARY.type("LR-I").T_in_out[4], se3.exp([0, 0, 0, 0, 0, 0.5 * np.pi])
    M[1] = (
        LIBRARY.type("JR").T_in_out[0] @ turn @ way @ se3.exp(errors["S2", "whole"]) @ se3.exp(errors["S3", "to_axis"])
    )
    M[2] = LIBRARY.type("JR").T_in_out[0] @ se3.exp(errors["S3", "from_axis"]) @ LIBRARY.type("LP").T_in_out[7]
    M[2] = M[2] @ se3.exp([0, 0, 0, 0, 0, np.pi])
    assert np.abs(chain.origins - M).max() < 1e-15
    assert np.abs(read_chain(urdf_of(assembly, LIBRARY, errors)).origins - M).max() < 1e-15


def test_bodies_weigh_what_the_library_says(rng: np.random.Generator) -> None:
    """Mass and centre of the moving parts, as gravity sees them, are those of the modules."""
    assembly = random_assembly(rng, joints=4)
    chain, text = chain_of(assembly, LIBRARY), urdf_of(assembly, LIBRARY)
    inertias = read_inertias(text, chain)
    kinds = [(LIBRARY.types[m.kind], m.size) for m in assembly.modules]
    expected = [kinds[1 + 2 * k][0].mass + body(*kinds[2 + 2 * k]).mass for k in range(4)]
    expected[-1] += LIBRARY.type("G").mass
    assert inertias.mass == pytest.approx(expected)
    lc = body(LIBRARY.type("LC"), 4)
    assert lc.centre == pytest.approx([0, 0, 0.03])
    assert lc.mass == pytest.approx(0.2 + 5.0 * 0.06)
    across = lc.mass * (3 * 0.035**2 + 0.06**2) / 12
    assert np.diag(lc.inertia) == pytest.approx([across, across, 0.5 * lc.mass * 0.035**2])
    model = pin.buildModelFromXML(text)
    assert [i.mass for i in list(model.inertias)[1:]] == pytest.approx(expected)


@pytest.mark.parametrize(
    ("modules", "words"),
    [
        ([], "it is empty"),
        ([Module("JR")], "a joint stands first: use a base here"),
        ([Module("B"), Module("LC")], "a link stands after a base: use a joint here"),
        ([Module("B"), Module("JR"), Module("JR")], "use a link here"),
        ([Module("B"), Module("JR"), Module("LC")], "it ends in a link: end it in a gripper"),
        ([Module("B"), Module("JR"), Module("LC"), Module("G"), Module("G")], "use a nothing here"),
        ([Module("B"), Module("JX")], "use JR"),
        ([Module("B", 8)], "its length code is 8, 0 to 7 are there"),
        ([Module("B"), Module("JR", 1)], "its length code is 1, 0 to 0 are there"),
        ([Module("B"), Module("JR", turn=4)], "turned by 4 quarter turns"),
        ([Module("B", turn=1)], "a base has no turn"),
        ([Module("B", serial="A"), Module("JR", serial="A")], "serial number A is at module 1 already"),
    ],
)
def test_what_cannot_be_built_is_refused(modules: list[Module], words: str) -> None:
    with pytest.raises(BadTable) as refusal:
        chain_of(Assembly(tuple(modules)), LIBRARY)
    assert words in str(refusal.value)
    assert "\n" not in str(refusal.value)


def changed(*path: str, to: Any) -> Any:
    data = copy.deepcopy(PUBLISHED)
    at = data
    for key in path[:-1]:
        at = at[key]
    if to is None:
        del at[path[-1]]
    else:
        at[path[-1]] = to
    return data


@pytest.mark.parametrize(
    ("data", "words"),
    [
        ([], "is not a mapping"),
        ({"modules": {}}, "'modcal_modules' is not stated"),
        (changed("modules", "G", to=None), "there is no gripper"),
        (changed("modules", "LC", "code", to=1), "two kinds of link have the same code"),
        (changed("modules", "LC", "role", to="leg"), "role: 'leg' is not one of base"),
        (changed("modules", "LC", "colour", to="red"), "unknown key colour"),
        (changed("modules", "LC", "motion", to="revolute"), "a joint, and nothing else, has a motion"),
        (changed("modules", "LC", "output", "along", to=[0, 0, 0]), "has a length without a direction"),
        (changed("modules", "LC", "length_m", to={"first": 40, "step": 5}), "give metres"),
        (changed("modules", "JP", "limits", to={}), "a sliding joint has an end"),
        (changed("modules", "JR", "limits", "lower", to=4), "run from 4 to 2.967"),
        (changed("modules", "JR", "radius_m", to=0), "radius_m: 0 is not above 0"),
        (changed("modules", "JR", "output", "xyz", to=[0, 0]), "xyz: it has 2 entries"),
        (changed("tolerances", "module", "length_m", to=0), "length_m: 0 is not above 0"),
    ],
)
def test_a_library_that_says_too_little_is_refused(data: Any, words: str) -> None:
    with pytest.raises(BadTable) as refusal:
        library_from_data(data, "mine.yaml")
    assert words in str(refusal.value)
    assert str(refusal.value).startswith("mine.yaml")


TEXT = (Path(__file__).resolve().parents[2] / "docs" / "modules.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", TEXT, re.DOTALL)


@pytest.mark.slow
def test_the_example_runs() -> None:
    programs = blocks("python")
    assert programs
    for program in programs:
        exec(compile(program, "docs/modules.md", "exec"), {})


def test_the_list_and_the_matrix_are_one_arm() -> None:
    listed, matrix = (assembly_from_data(yaml.safe_load(text), LIBRARY, "docs") for text in blocks("yaml"))
    assert matrix == numbered(listed, [""] * len(listed.modules))


def test_the_table_of_modules_is_the_library() -> None:
    rows = re.findall(r"^\| ([\w-]+) \| (base|joint|link|gripper)[^|]*\| ([^|]*)\|", TEXT, re.MULTILINE)
    assert {name: role for name, role, _ in rows} == {t.name: t.role for t in LIBRARY.types.values()}
    for name, _, said in rows:
        kind = LIBRARY.type(name)
        stated = [float(x) for x in re.findall(r"[\d.]+", said)]
        assert stated == ([1e3 * kind.first, 1e3 * kind.step] if kind.sizes > 1 else [])


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
    joint, _, link, size, _ = coding.fields(np.arange(np.prod(coding.shape)))
    assert np.array_equal(coding.buildable, (joint < 3) & (link < 3) & ((link != 1) | (size == 0)))
    assembly = Assembly.build((1, 2), [("JX", 1, "LP", 0, 3)])
    assert coding.text(coding.genome(assembly)) == "00110 10·01·01·000·11"
    assert coding.assembly(coding.genome(assembly)) == assembly
    with pytest.raises(BadTable, match="no module has it"):
        coding.assembly(coding.parse("00110 11·01·01·000·11"))
    with pytest.raises(BadTable, match="length code is 1"):
        coding.assembly(coding.parse("00110 10·01·01·001·11"))


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
            assembly = numbered(assembly, known)
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
    (with_row("LP", "", "0,2,0", "0,3,0", "", "", ""), "row LP, column 2: holds 0,2,0, the arm 1,2,0"),
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
