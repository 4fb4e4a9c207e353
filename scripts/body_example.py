"""The files in ``examples/body``: two cameras, a block of twenty markers on a Panda in MuJoCo, 45 postures.

``python scripts/body_example.py`` writes them; what they hold differs from the drawings of arm and block at random.
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from camera.bodies import SIZE, Faults, body_scene, bundle_to_data, icosahedron, measured  # noqa: E402

from modcal_core.files import to_yaml  # noqa: E402

FOLDER = ROOT / "examples" / "body"
POSTURES, SEED = 45, 21


def main() -> None:
    """Write the files."""
    drawing = measured(icosahedron())
    s = body_scene(SEED, POSTURES, 2, Faults(late=1), drawing=drawing)
    numbers = [m.id for m in drawing.markers]
    lines = ["camera,image,marker,u,v,width,height"]
    for one in s.images:
        for v in one.views:
            lines += [
                f"{one.name},{v.name},{numbers[point // 5]},{x:.2f},{y:.2f},{SIZE[0]},{SIZE[1]}"
                for point, (x, y) in zip(v.ids, v.pixels, strict=True)
            ]
    FOLDER.mkdir(exist_ok=True)
    (FOLDER / "corners.csv").write_text("\n".join(lines) + "\n")
    rows = [",".join([f"{i}", *(f"{x:.6f}" for x in q)]) for i, q in enumerate(s.q)]
    (FOLDER / "joints.csv").write_text("\n".join([",".join(["image", *s.chain.names]), *rows]) + "\n")
    (FOLDER / "target.yaml").write_text(to_yaml(bundle_to_data(drawing)))


if __name__ == "__main__":
    main()
