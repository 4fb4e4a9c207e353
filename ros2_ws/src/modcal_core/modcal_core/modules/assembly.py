"""Which modules are bolted together, in which order, and how each is turned against the one before it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from modcal_core.errors import BadTable
from modcal_core.modules.library import BASE, GRIPPER, JOINT, LINK, TURNS, Library

_NEXT = {"": (BASE,), BASE: (JOINT,), JOINT: (LINK,), LINK: (JOINT, GRIPPER), GRIPPER: ()}


@dataclass(frozen=True)
class Module:
    """One module in its place.

    kind: its name in the library. size: code 0 … 7 of its length. turn: quarter turns about z, 0 … 3, of its input
    frame against the output frame of the module before it; 0 for a base. serial: of the physical module; "" unknown.
    """

    kind: str
    size: int = 0
    turn: int = 0
    serial: str = ""


@dataclass(frozen=True)
class Assembly:
    """A chain of modules: a base, then a joint and a link as often as wanted, then a gripper."""

    modules: tuple[Module, ...]
    name: str = "modular_arm"

    @classmethod
    def build(
        cls,
        base: tuple[int, int],
        subassemblies: Iterable[tuple[str, int, str, int, int]],
        base_kind: str = "B",
        gripper_kind: str = "G",
        name: str = "modular_arm",
    ) -> Assembly:
        """The assembly in the order of the published code.

        base: (size, turn), the turn being that of the first joint on the base. subassemblies: (joint kind, turn, link
        kind, size, turn), the first turn being that of the link on the joint, the second that of what comes next on
        the link.
        """
        modules = [Module(base_kind, base[0])]
        turn = base[1]
        for joint, link_turn, link, size, next_turn in subassemblies:
            modules += [Module(joint, 0, turn), Module(link, size, link_turn)]
            turn = next_turn
        return cls((*modules, Module(gripper_kind, 0, turn)), name)

    @property
    def joints(self) -> tuple[Module, ...]:
        """The joints, base to gripper."""
        return self.modules[1:-1:2]

    @property
    def links(self) -> tuple[Module, ...]:
        """The links, base to gripper; link i is bolted onto joint i."""
        return self.modules[2:-1:2]

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.joints)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints in the arm that comes of it: joint_1 …"""
        return tuple(f"joint_{k + 1}" for k in range(self.n))

    def with_serials(self, serials: Sequence[str]) -> Assembly:
        """The same assembly of these physical modules, one serial number each, base to gripper."""
        named = (replace(m, serial=s) for m, s in zip(self.modules, serials, strict=True))
        return replace(self, modules=tuple(named))

    def checked(self, library: Library, source: str = "assembly") -> Assembly:
        """The same assembly, if it can be built from this library. Raises BadTable at the first fault."""
        before = ""
        seen: dict[str, int] = {}
        for i, module in enumerate(self.modules):
            what = f"{source}: module {i + 1}"
            kind = library.type(module.kind, what)
            if kind.role not in _NEXT[before]:
                after = f"stands after a {before}" if before else "stands first"
                wanted = " or a ".join(_NEXT[before]) or "nothing"
                raise BadTable(f"{what} ({module.kind})", f"a {kind.role} {after}", f"use a {wanted} here")
            if isinstance(module.size, bool) or not isinstance(module.size, int) or not 0 <= module.size < kind.sizes:
                limit = f"its length code is {module.size!r}, 0 to {kind.sizes - 1} are there"
                raise BadTable(f"{what} ({module.kind})", limit, "choose a length of the library")
            if isinstance(module.turn, bool) or not isinstance(module.turn, int) or not 0 <= module.turn < TURNS:
                said = f"it is turned by {module.turn!r} quarter turns, 0 to {TURNS - 1} are possible"
                raise BadTable(f"{what} ({module.kind})", said, "give 0, 1, 2 or 3, or degrees 0, 90, 180, 270")
            if i == 0 and module.turn:
                raise BadTable(f"{what} ({module.kind})", "a base has no turn", "turn the first joint")
            if module.serial and module.serial in seen:
                said = f"serial number {module.serial} is at module {seen[module.serial]} already"
                raise BadTable(f"{what} ({module.kind})", said, "give each physical module its own")
            seen[module.serial] = i + 1
            before = kind.role
        if before != GRIPPER:
            ends = f"it ends in a {before}" if before else "it is empty"
            raise BadTable(source, ends, "end it in a gripper")
        return self
