"""An arm with what it carries and what its drives may give: from a URDF and a few numbers."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from modcal_core.errors import BadRobot
from modcal_core.geometry import Array
from modcal_core.robots.acceleration import DOWN, Drives, Window, read_drives, window
from modcal_core.robots.bodies import Payload, with_payload
from modcal_core.robots.chain import Chain
from modcal_core.robots.urdf import read_chain
from modcal_core.robots.urdf_inertias import Inertias, read_inertias

COUPLED, EQUIVALENT = "coupled", "equivalent"
METHODS = (COUPLED, EQUIVALENT)


@dataclass(frozen=True)
class LoadedArm:
    """chain, bare inertias and drives as the URDF has them; payload at the tip; share of the torque that may be used;
    gravity (3,) [m/s²] in the base.
    """

    chain: Chain
    inertias: Inertias
    drives: Drives
    payload: Payload = field(default_factory=Payload)
    share: float = 1.0
    gravity: Array = field(default_factory=lambda: np.array(DOWN))

    @classmethod
    def read(
        cls, urdf_xml: str, base: str | None = None, tip: str | None = None, recorded: Collection[str] | None = None
    ) -> LoadedArm:
        """The arm of a URDF, carrying nothing; base, tip, recorded as of :func:`read_chain`. Raises BadRobot."""
        chain = read_chain(urdf_xml, base, tip, recorded)
        inertias = read_inertias(urdf_xml, chain)
        if not inertias.known:
            raise BadRobot("robot description", "states no mass of any link", "write the links' <inertial>")
        return cls(chain, inertias, read_drives(urdf_xml, chain))

    def carrying(self, payload: Payload) -> LoadedArm:
        """The arm with another payload."""
        return replace(self, payload=payload)

    def using(self, share: float, gravity: ArrayLike = DOWN) -> LoadedArm:
        """The arm with this share of its torque, in this gravity. Raises BadRobot for numbers that are none."""
        g = np.asarray(gravity, dtype=float).ravel()
        if not (np.isfinite(share) and 0.0 < share <= 1.0):
            raise BadRobot(
                "share of the torque", f"{share:g} is not above 0 and at most 1", "give a share, such as 0.8"
            )
        if g.shape != (3,) or not np.isfinite(g).all() or np.linalg.norm(g) > 100.0:
            raise BadRobot("gravity", "is not x y z of 100 m/s² at most", "give it in the base link, such as 0 0 -9.81")
        return replace(self, share=float(share), gravity=g)

    def with_drives(self, **values: Mapping[str, float]) -> LoadedArm:
        """The arm with other torque, speed, coulomb, viscous or rotor of its drives, by joint. Raises BadRobot."""
        drives = self.drives
        for what, by_joint in values.items():
            drives = drives.with_values(what, by_joint)
        return replace(self, drives=drives)

    def window(self, q: ArrayLike, velocity: ArrayLike | None = None) -> Window:
        """What the drives leave for accelerating at q, at a velocity, (N, n) each. Raises BadRobot."""
        return window(self.chain, self._loaded, self.drives, q, velocity, self.share, self.gravity)

    @cached_property
    def _loaded(self) -> Inertias:
        """The inertias with what is carried, which a node asks for at every posture."""
        return with_payload(self.inertias, self.chain, self.payload)

    def bounds(self, q: ArrayLike, velocity: ArrayLike | None = None, method: str = COUPLED) -> tuple[Array, Array]:
        """Lower and upper bounds of acceleration (N, n) [rad/s², m/s²], lower < 0 < upper.

        method: "coupled", bounds that hold together whatever the other joints do within theirs, or "equivalent", each
        joint by its equivalent inertia. Raises Overloaded where the drives cannot hold the arm, BadRobot for what is
        not known.
        """
        require_method(method)
        left = self.window(q, velocity)
        left.require_held()
        return left.box() if method == COUPLED else left.equivalent()


def require_method(method: str) -> None:
    """Raises BadRobot for a method that there is none of."""
    if method not in METHODS:
        raise BadRobot(f"method '{method}'", f"is neither {' nor '.join(METHODS)}", "choose one of them")
