"""Arms in MuJoCo that look at a board, or hold one: images' corners with a truth that the model has no part in."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from camera.boards import BOARD, LENS, facing, views

from modcal_core.camera.bundle import BoardView, PrintedTarget
from modcal_core.camera.lens import Lens
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.robots.chain import Chain
from modcal_core.robots.mechanism import inverse_batch
from modcal_core.robots.urdf import read_chain
from modcal_nodes.simulation.mjcf import World

PANDA = Path(__file__).parents[2] / "examples" / "robots" / "panda.urdf"
HOME = np.array([0.0, -0.5, 0.0, -2.2, 0.0, 1.8, 0.8])
CAMERA_ON_TIP = se3.transform(so3.exp([0.02, 0.01, 0.7]), [0.06, 0.02, 0.03])
BOARD_ON_TIP = se3.transform(so3.exp([0.0, np.pi / 2, 0.0]) @ so3.exp([0.05, -0.04, 0.3]), [-0.04, 0.06, 0.08])
BOARD_IN_WORLD = se3.transform(so3.exp([np.pi, 0.0, 0.0]), [0.42, 0.06, 0.0])
CAMERA_IN_WORLD = se3.transform(np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), [1.0, 0.05, 0.5])


@dataclass(frozen=True)
class CameraScene:
    """chain: nominal. world: as built. q: as reported, (N, n). T: true T_frame_tool, (N, 4, 4). views: of the board."""

    chain: Chain
    world: World
    q: Array
    T: Array
    views: list[BoardView]
    on_tip: bool
    lens: Lens
    board: PrintedTarget

    def truth(self, q: Array) -> Array:
        """True T_frame_tool (M, 4, 4) at other postures."""
        return self.world.tool_in_tracker(q)


def panda() -> Chain:
    return read_chain(PANDA.read_text(), tip="panda_link8")


def scene(
    seed: int,
    on_tip: bool,
    count: int = 25,
    length_std: float = 4e-3,
    angle_std: float = 6e-3,
    repeat_rad: float = 5e-5,
    noise: float = 0.1,
    lens: Lens = LENS,
    board: PrintedTarget = BOARD,
    printed: Array | None = None,
    velocity: Array | None = None,
    delay_s: float = 0.0,
    compliance: float = 0.0,
) -> CameraScene:
    """Images of a Panda whose bodies are displaced by some 7 mm each, and whose joints repeat to repeat_rad."""
    rng = np.random.default_rng(seed)
    chain = panda()
    tool, frame = (CAMERA_ON_TIP, BOARD_IN_WORLD) if on_tip else (BOARD_ON_TIP, CAMERA_IN_WORLD)
    world = World(chain, rng, length_std, angle_std, se3.inverse(frame), tool, compliance=compliance)
    q = np.empty((0, chain.n))
    while len(q) < count:
        T = facing(rng, 2 * count, tilt=0.6, near=0.35, far=0.6)
        wanted = frame @ (se3.inverse(T) if on_tip else T) @ se3.inverse(tool)
        found = inverse_batch(chain, wanted, HOME + 0.3 * rng.normal(size=(2 * count, chain.n)), tolerance=1e-3)
        q = np.concatenate([q, found.q[found.met]])
    q = q[:count]
    moved = q if velocity is None else q - delay_s * velocity
    T = world.tool_in_tracker(moved + repeat_rad * rng.standard_normal(q.shape))
    seen = views(rng, se3.inverse(T) if on_tip else T, noise, lens, board, printed)
    keep = [i for i, v in enumerate(seen) if len(v) >= 8]
    return CameraScene(chain, world, q[keep], T[keep], [seen[i] for i in keep], on_tip, lens, board)
