"""A family is one file, built in as in a package: the same file is found in both, and enters in the same way."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]

FILE = """
from modcal_core.effects.effect import AXIS, Effect
from modcal_core.effects.family import PLAIN, Family
from modcal_core.effects.shapes import Setting, Shape, ShapeKind
from modcal_core.effects.sizes import value
import numpy as np

def candidates(drivers):
    for name in drivers.arm.chain.names:
        yield Effect("stick", name, AXIS, f"slip:{name}", Shape("bent", {"sharp": 2.0}))

FAMILY = Family(
    "stick",
    candidates,
    shapes={"bent": ShapeKind(lambda x, s: np.tanh(s["sharp"] * x)[None], refined={"sharp": Setting(0.5)})},
    drivers={"slip": lambda drivers, joint: drivers.values(f"position:{joint}") ** 2},
    complexity=lambda effect: PLAIN,
    sizes=lambda effect, chain: {"slip": value(effect, 0, 1e3, "mrad")},
    sentence=lambda entry: f"{entry.place} sticks by {entry.sizes['slip'][0]:g} mrad",
)
"""
# The columns that the scan looks at, and what a report says, by the functions that everything else calls.
PROGRAM = """
import json, sys
import numpy as np
if sys.argv[1:]:
    from modcal_core.effects import families as built_in
    built_in.__path__.append(sys.argv[1])
from cells import record, ur10
from modcal_core.effects.drivers import Drivers, NominalArm
from modcal_core.effects.effect import columns, prior_stds
from modcal_core.effects.family import ReportEntry
from modcal_core.effects.registry import candidates, complexity, family_named, known_families, require_known

drivers = Drivers(record(1, 20).samples, NominalArm(ur10()))
found = [e for e in candidates(drivers) if e.family == "stick"]
effect = found[2].with_values([3e-4, 2.5], [1e-5, 0.1])
require_known(effect)
x = drivers.samples.q[:, 2]
(term,) = columns(effect, drivers)[0]
sizes = family_named("stick").sizes(effect, ur10())
print(json.dumps(dict(
    families=list(known_families()), count=len(found), complexity=complexity(effect),
    right=bool(np.allclose(term.size, np.tanh(2.5 * x**2), atol=1e-15)), priors=prior_stds(effect, drivers).tolist(),
    said=family_named("stick").sentence(ReportEntry(effect.place, "axis", effect.public_driver, sizes)))))
"""


def told(folder: Path, *arguments: str, path: tuple[str, ...] = ()) -> dict[str, Any]:
    paths = os.pathsep.join([*path, str(ROOT / "tests"), *sys.path])
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, *arguments],
        env={**os.environ, "PYTHONPATH": paths},
        capture_output=True,
        text=True,
        cwd=folder,
    )
    assert done.returncode == 0, done.stderr
    return dict(json.loads(done.stdout))


@pytest.mark.slow
def test_one_file_is_a_family_built_in_and_in_a_package(tmp_path: Path) -> None:
    built_in, package = tmp_path / "built_in", tmp_path / "package"
    info = package / "stick-1.0.dist-info"
    for folder in (built_in, info):
        folder.mkdir(parents=True)
    (built_in / "stick.py").write_text(FILE)
    (package / "stick.py").write_text(FILE)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: stick\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[modcal.effects]\nstick = stick:FAMILY\n")

    inside = told(tmp_path, str(built_in))
    assert inside["families"][-1] == "stick"  # behind those of the list, which decide between equals
    assert (inside["count"], inside["complexity"], inside["right"]) == (6, 0, True)
    assert inside["said"] == "elbow_joint sticks by 0.3 mrad"
    assert inside["priors"][1] == 0.5
    assert told(tmp_path, path=(str(package),)) == inside
