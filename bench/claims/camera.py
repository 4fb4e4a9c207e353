"""A camera on the wrist that looks at a printed board: corners of images, by a pinhole with two radial terms."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import yaml
from arm import Array, Serial, pose
from ways import Site

SIZE, SQUARE = (1280, 720), 0.03  # pixels, m
COLUMNS, ROWS = 9, 6  # squares of the chessboard
FEWEST, MOST = 15, 40  # images
PIXEL = 0.1
RULER = 1e-4  # m, to what the sheet was measured


class Camera:
    """What a camera on the tool sees of a board that stands before its middle posture."""

    def __init__(self, site: Site) -> None:
        rng, arm = site.rng, site.world.drawn
        assert isinstance(arm, Serial)
        self.site = site
        self.lens = np.array([*rng.uniform(850.0, 1000.0, 1), 640.0, 360.0, rng.uniform(-0.15, 0.0), 0.05])
        self.grown = 1.0 + rng.normal(0.0, RULER / 0.2)
        row, column = np.divmod(np.arange((COLUMNS - 1) * (ROWS - 1)), COLUMNS - 1)
        self.points = self.grown * SQUARE * np.stack([column + 1.0, row + 1.0, 0.0 * row], axis=1)
        half = 0.5 * (arm.high - arm.low)
        self.middle = arm.low + half + rng.uniform(-0.4, 0.4, len(half)) * half
        centre = self.points.mean(axis=0)
        before = pose(np.array([0.0, 0.0, 0.45]), rng.normal(0.0, 0.2, 3)) @ pose(-centre, np.zeros(3))
        self.board = site.world.poses(self.middle[None], np.ones((1, len(half))))[0] @ before

    def corners(self, T: Array) -> Array:
        """Pixels (N, C, 2) of the corners for cameras T (N, 4, 4) in the base; NaN where one is not to be seen."""
        seen = np.linalg.inv(T) @ self.board
        p = np.einsum("nij,cj->nci", seen[:, :3, :3], self.points) + seen[:, None, :3, 3]
        f, u, v, k1, k2 = self.lens
        flat = p[:, :, :2] / np.maximum(p[:, :, 2:], 1e-3)
        r2 = (flat**2).sum(axis=2, keepdims=True)
        pixels = flat * (1.0 + k1 * r2 + k2 * r2 * r2) * f + [u, v]
        inside = (pixels > 5.0).all(axis=2) & (pixels < np.array(SIZE) - 5.0).all(axis=2)
        facing = (seen[:, 2, 2] > 0.45) & (p[:, :, 2].min(axis=1) > 0.2) & (p[:, :, 2].max(axis=1) < 1.0)
        return np.where((inside & (r2[:, :, 0] < 1.0) & facing[:, None])[..., None], pixels, np.nan)

    def postures(self, count: int, low: Array, high: Array) -> Array:
        """Random postures between these ends at which most of the board is in the image, at most so many."""
        found: list[Array] = []
        for _ in range(40):
            q = self.site.rng.uniform(low, high, (4000, len(low)))
            seen = np.isfinite(self.corners(self.site.world.poses(q, np.ones(q.shape)))[:, :, 0]).mean(axis=1)
            found += list(q[seen > 0.75])
            if len(found) >= count:
                break
        return np.array(found[:count])

    def record(self, folder: Path) -> Array:
        """Write images, joints, target and drawing's names of it to a folder; the postures (N, n)."""
        site = self.site
        q = self.postures(int(np.clip(site.count, FEWEST, MOST)), self.middle - 0.7, self.middle + 0.7)
        pixels = self.corners(site.at(q)) if len(q) else np.zeros((0, 0, 2))
        pixels = pixels + PIXEL * site.rng.normal(size=pixels.shape)
        rows = [
            f"{i},{c},{u:.4f},{v:.4f},{SIZE[0]},{SIZE[1]}"
            for i, image in enumerate(pixels)
            for c, (u, v) in enumerate(image)
            if np.isfinite(u)
        ]
        (folder / "corners.csv").write_text("\n".join(["image,id,u,v,width,height", *rows]) + "\n")
        joints = [",".join([str(i), *(f"{x:.9f}" for x in one)]) for i, one in enumerate(q)]
        heads = ",".join(["image", *site.world.drawn.names])
        (folder / "joints.csv").write_text("\n".join([heads, *joints]) + "\n")
        rulers = {"x": 0.24, "y": 0.15}
        said = {f"{a}_m": d for a, d in rulers.items()}
        said |= {f"measured_{a}_m": float(self.grown * d + RULER * site.rng.normal()) for a, d in rulers.items()}
        target = {"modcal_target": 1, "type": "chessboard", "columns": COLUMNS, "rows": ROWS, "square_m": SQUARE}
        (folder / "target.yaml").write_text(yaml.safe_dump({**target, "rulers": said}))
        return q
