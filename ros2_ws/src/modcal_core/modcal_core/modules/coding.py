"""Assemblies as numbers, in the published code (Gao et al. 2014): what a search cuts, mixes and changes.

A base is [length, turn], 3 and 2 bits, the turn being that of the first joint on it. Every further sub-assembly is a
joint with its link, [joint, turn, link, length, turn], 1, 2, 2, 3 and 2 bits: the first turn is that of the link on the
joint, the second that of whatever comes next on the link. Written out: ``00001 0·01·10·100·00 …``. Read as whole
numbers, a base is one of 32 and a sub-assembly, called a *gene* here, one of 1024; an arm of n joints is n + 1 of them.

The kinds behind the codes, and the lengths, are the library's. One with more than two kinds of joint has one more bit
for them; a code that no module has makes a gene that cannot be built.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.errors import BadTable
from modcal_core.modules.assembly import Assembly
from modcal_core.modules.library import JOINT, LINK, SIZES, TURNS, Library, ModuleType

BASES = SIZES * TURNS
FIELDS = ("joint", "turn", "link", "length", "next turn")
DOT = "·"


@dataclass(frozen=True)
class Coding:
    """The code of a library's assemblies. A genome is (n + 1,) whole numbers: the base, then a gene for every joint."""

    library: Library

    @cached_property
    def joints(self) -> tuple[ModuleType | None, ...]:
        """Kinds of joint by code; None where no module has it."""
        return self._by_code(JOINT, 1)

    @cached_property
    def links(self) -> tuple[ModuleType | None, ...]:
        """Kinds of link by code; None where no module has it."""
        return self._by_code(LINK, 2)

    def _by_code(self, role: str, bits: int) -> tuple[ModuleType | None, ...]:
        kinds = {t.code: t for t in self.library.of_role(role)}
        bits = max(bits, int(max(kinds)).bit_length())
        return tuple(kinds.get(code) for code in range(2**bits))

    @cached_property
    def shape(self) -> tuple[int, int, int, int, int]:
        """How many codes each field of a gene has, in the order of ``FIELDS``."""
        return len(self.joints), TURNS, len(self.links), SIZES, TURNS

    @property
    def genes(self) -> int:
        """How many genes there are, buildable or not."""
        return int(np.prod(self.shape))

    def fields(self, genes: ArrayLike) -> np.ndarray:
        """The five fields of genes (...), (5, ...)."""
        return np.stack(np.unravel_index(np.asarray(genes), self.shape))

    @cached_property
    def buildable(self) -> np.ndarray:
        """Whether the library has the joint, the link and its length, for every gene, (genes,)."""
        joint, _, link, size, _ = self.fields(np.arange(self.genes))
        sizes = np.array([0 if kind is None else kind.sizes for kind in self.links])
        return np.array([kind is not None for kind in self.joints])[joint] & (size < sizes[link])

    @cached_property
    def base_buildable(self) -> np.ndarray:
        """Whether the library has the base's length, (32,)."""
        return np.arange(BASES) // TURNS < self.library.base.sizes

    def assembly(self, genome: Sequence[int] | np.ndarray, name: str = "modular_arm") -> Assembly:
        """The assembly of a genome, checked. Raises BadTable where the library lacks a module or a length."""
        parts = []
        for k, gene in enumerate(genome[1:]):
            joint, turn, link, size, next_turn = (int(f) for f in self.fields(int(gene)))
            kinds = self.joints[joint], self.links[link]
            if kinds[0] is None or kinds[1] is None:
                remedy = "use a code that the library has"
                raise BadTable(f"code {self.gene_text(int(gene))} of joint {k + 1}", "no module has it", remedy)
            parts.append((kinds[0].name, turn, kinds[1].name, size, next_turn))
        base = int(genome[0]) // TURNS, int(genome[0]) % TURNS
        ends = self.library.base.name, self.library.gripper.name
        return Assembly.build(base, parts, *ends, name=name).checked(self.library, name)

    def genome(self, assembly: Assembly) -> np.ndarray:
        """The genome (n + 1,) of an assembly that has been checked; its name and serial numbers are not in it."""
        turns = [m.turn for m in assembly.modules]
        out = [assembly.modules[0].size * TURNS + turns[1]]
        for k, (joint, link) in enumerate(zip(assembly.joints, assembly.links, strict=True)):
            kinds = self.library.types[joint.kind], self.library.types[link.kind]
            fields = (kinds[0].code, turns[2 * k + 2], kinds[1].code, link.size, turns[2 * k + 3])
            out.append(int(np.ravel_multi_index(fields, self.shape)))
        return np.array(out)

    @cached_property
    def _widths(self) -> tuple[int, ...]:
        return tuple((count - 1).bit_length() for count in self.shape)

    def gene_text(self, gene: int) -> str:
        """A gene in bits, such as ``0·01·10·100·00``."""
        return DOT.join(f"{int(f):0{w}b}" for f, w in zip(self.fields(gene), self._widths, strict=True))

    def text(self, genome: Sequence[int] | np.ndarray) -> str:
        """A genome in bits: the base, then the genes, with spaces between."""
        return " ".join([f"{int(genome[0]):05b}", *(self.gene_text(int(g)) for g in genome[1:])])

    def parse(self, text: str) -> np.ndarray:
        """The genome (n + 1,) of a text in bits; dots may be left out. Raises BadTable."""
        words = text.replace(DOT, "").replace(".", "").split()
        wide = sum(self._widths)
        for k, word in enumerate(words):
            length = wide if k else 5
            if len(word) != length or set(word) - {"0", "1"}:
                what = f"code of joint {k}" if k else "code of the base"
                raise BadTable(f"{what} '{word}'", f"is not {length} bits", "write 00001 0·01·10·100·00 …")
        if len(words) < 2:
            raise BadTable(f"code '{text}'", "has no joint", "write 00001 0·01·10·100·00 …")
        return np.array([int(word, 2) for word in words])

    def lines(self, genome: Sequence[int] | np.ndarray) -> list[str]:
        """What a person reads: a line for the base and each joint with its link; lengths in mm, turns in degrees."""
        size, turn = divmod(int(genome[0]), TURNS)
        out = [f"{int(genome[0]):05b}: {_sized(self.library.base, size)}, {90 * turn}°"]
        for gene in genome[1:]:
            joint, turn, link, size, next_turn = (int(f) for f in self.fields(int(gene)))
            kinds = self.joints[joint], self.links[link]
            names = "-" if kinds[0] is None else kinds[0].name, "-" if kinds[1] is None else _sized(kinds[1], size)
            out.append(f"{self.gene_text(int(gene))}: {names[0]}, {90 * turn}°, {names[1]}, {90 * next_turn}°")
        return out


def _sized(kind: ModuleType, size: int) -> str:
    return f"{kind.name} {1e3 * kind.length(size):.10g} mm"
