"""The published code: its printed answer, bit by bit, and back; and the tables that a search looks genes up in."""

from __future__ import annotations

import numpy as np
import pytest
import yaml
from modules.arms import LIBRARY, five_joints, random_assembly

from modcal_core.errors import BadTable
from modcal_core.modules.catalogue import Catalogue
from modcal_core.modules.coding import Coding
from modcal_core.modules.library import Assembly, library_from_data, published_text
from modcal_core.modules.poe import chain_of
from modcal_core.modules.urdf import body

CODING = Coding(LIBRARY)
ANSWER = "00001 0·01·10·100·00 0·00·01·111·10 0·00·01·111·10 0·10·11·111·10 0·01·00·110·01"


def test_the_published_answer_decodes_as_printed() -> None:
    genome = CODING.parse(ANSWER)
    assert CODING.lines(genome) == [
        "00001: B 0 mm, 90°",
        "0·01·10·100·00: JR, 90°, LR-I 91.5 mm, 0°",
        "0·00·01·111·10: JR, 0°, LP 215 mm, 180°",
        "0·00·01·111·10: JR, 0°, LP 215 mm, 180°",
        "0·10·11·111·10: JR, 180°, LR-II 106.5 mm, 180°",
        "0·01·00·110·01: JR, 90°, LC 70 mm, 90°",
    ]
    assert CODING.assembly(genome) == five_joints()
    assert CODING.text(CODING.genome(five_joints())) == ANSWER


def test_a_gene_is_its_ten_bits() -> None:
    assert CODING.genes == 1024
    for gene in range(1024):
        assert CODING.gene_text(gene).replace("·", "") == f"{gene:010b}"
    assert CODING.buildable.all()
    assert CODING.base_buildable.all()


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
