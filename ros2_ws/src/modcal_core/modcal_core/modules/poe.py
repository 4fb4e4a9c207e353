"""The product of exponentials of an assembly, straight from the modules (Gao et al. 2014).

With T^B, T^J, T^L, T^G the way through each module, joints at zero, and R the quarter turns between neighbours,

    T_1 = T^B R,   T_i = T_{i-1} T^J_{i-1} R T^L_{i-1} R,   T_{n+1} = T_n T^J_n R T^L_n R T^G,

T_i is the input frame of joint i, whose axis is z there: ξ_i = (p_i × ω_i, ω_i) where it turns and (ω_i, 0) where it
slides, and ``T(q) = exp(ξ_1 q_1) … exp(ξ_n q_n) T_{n+1}``. In the local form of :class:`Chain` the constants between
the joints are M_0 = T_1, M_i = T_i⁻¹ T_{i+1}: each a product of *pieces*, one for every part of a module and every pair
of flanges it consists of. Behind each piece stands the error of its owner, a small transform exp(e).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from modcal_core.geometry import Array, se3, sealed
from modcal_core.modules.library import JOINT, Assembly, Library
from modcal_core.robots import Chain

BASE_LINK, TIP_LINK = "base_link", "tool0"
# Which part of an owner a piece is: the way through a module, or, of a joint, the way to its axis and from it on.
WHOLE, TO_AXIS, FROM_AXIS = "whole", "to_axis", "from_axis"


# about z by 0, 90, 180, 270 degrees, exactly, (4, 4, 4)
TURN = sealed(
    np.stack([np.linalg.matrix_power(se3.transform([[0, -1, 0], [1, 0, 0], [0, 0, 1]]), k) for k in range(4)])
)


@dataclass(frozen=True)
class Piece:
    """One factor of a constant of the chain.

    T: nominal, (4, 4) [m]. module: index of the module it belongs to, or of the module behind the flanges that it is.
    part: "interface", or which part of the module.
    """

    T: Array
    module: int
    part: str = WHOLE

    @property
    def is_interface(self) -> bool:
        """Whether it is a pair of flanges, which is bolted again in every assembly."""
        return self.part == "interface"


def pieces(assembly: Assembly, library: Library) -> tuple[tuple[Piece, ...], ...]:
    """The factors of M_0 … M_n of the arm, base to tip, (n + 1) tuples; the assembly has been checked."""
    out: list[list[Piece]] = [[]]
    for i, module in enumerate(assembly.modules):
        kind = library.types[module.kind]
        if i:
            out[-1].append(Piece(TURN[module.turn], i, "interface"))
        if kind.role == JOINT:
            out[-1].append(Piece(np.eye(4), i, TO_AXIS))
            out.append([Piece(kind.T_in_out[module.size], i, FROM_AXIS)])
        else:
            out[-1].append(Piece(kind.T_in_out[module.size], i))
    return tuple(tuple(segment) for segment in out)


def chain_of(assembly: Assembly, library: Library, errors: Mapping[tuple[str, str], Array] | None = None) -> Chain:
    """The arm that an assembly makes, from base_link to tool0. Raises BadTable where it cannot be built.

    errors: twists (6,) [m, rad] by (serial number, part), of physical modules whose true geometry is known, each in the
    frame that its part ends in; parts are "whole", and "to_axis" and "from_axis" of joints.
    """
    assembly.checked(library)
    M = origins(assembly, library, errors)
    kinds = [library.types[m.kind] for m in assembly.joints]
    return Chain.build(
        names=assembly.joint_names,
        origins=M,
        revolute=[k.revolute for k in kinds],
        lower=[k.lower for k in kinds],
        upper=[k.upper for k in kinds],
        base=BASE_LINK,
        tip=TIP_LINK,
    )


def origins(assembly: Assembly, library: Library, errors: Mapping[tuple[str, str], Array] | None = None) -> Array:
    """M_0 … M_n of the arm, (n + 1, 4, 4) [m], errors put in as of :func:`chain_of`; the assembly has been checked."""
    M = []
    for segment in pieces(assembly, library):
        T = np.eye(4)
        for piece in segment:
            T = T @ piece.T
            serial = assembly.modules[piece.module].serial
            if errors and not piece.is_interface and serial and (serial, piece.part) in errors:
                T = T @ se3.exp(errors[serial, piece.part])
        M.append(T)
    return np.stack(M)


def module_frames(assembly: Assembly, library: Library, q: Array | None = None) -> Array:
    """Where every module is at a posture q (n,) [rad, m], default zero: (modules + 1, 4, 4) [m] in the base.

    Of each module the input frame, of a joint after its motion; then the gripper's output frame.
    """
    T, out, k = np.eye(4), [], 0
    for module in assembly.modules:
        kind = library.types[module.kind]
        T = T @ TURN[module.turn]
        if kind.role == JOINT:
            motion = np.zeros(6)
            motion[5 if kind.revolute else 2] = 0.0 if q is None else q[k]
            T, k = T @ se3.exp(motion), k + 1
        out.append(T)
        T = T @ kind.T_in_out[module.size]
    return np.stack([*out, T])
