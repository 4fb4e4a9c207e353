"""``modcal assemble``, ``modules learn`` and ``synthesize``: files, refusals, and the way from one to the other."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from cells import joint_track
from cli.conftest import Refused
from modules.arms import LIBRARY, five_joints, numbered
from modules.workshop import Arm, Made, shelf_of

from modcal_core.geometry import se3
from modcal_core.measurements.recording import ReadingTrack, Recording
from modcal_core.modules.coding import assembly_to_data
from modcal_core.modules.errors import twists_from_data
from modcal_core.modules.library import Assembly, chain_of, published_text
from modcal_core.robots.kinematics import chain_forward
from modcal_core.robots.urdf import read_chain
from modcal_msgs_py.recording_write import write_recording
from modcal_nodes.cli.main import run
from modcal_nodes.io.inputs import read_assembly

pytestmark = pytest.mark.slow

EXAMPLES = Path(__file__).resolve().parents[2] / "examples" / "modules"


def test_a_list_of_modules_and_its_matrix_give_the_same_robot(tmp_path: Path) -> None:
    for name in ("five_joints", "five_joints_aim"):
        assert run(["assemble", str(EXAMPLES / f"{name}.yaml"), "--out", str(tmp_path / name)]) == 0
        assert {p.name for p in (tmp_path / name).iterdir()} == {"robot.urdf", "assembly.yaml", "assembly.svg"}
    robots = [(tmp_path / name / "robot.urdf").read_text() for name in ("five_joints", "five_joints_aim")]
    assert robots[0] == robots[1]
    assert np.array_equal(read_chain(robots[0]).origins, read_chain(robots[1]).origins)
    assert read_chain(robots[0]).names == tuple(f"joint_{k}" for k in range(1, 6))
    assert np.abs(read_chain(robots[0]).origins - chain_of(five_joints(), LIBRARY).origins).max() < 1e-15
    assert (tmp_path / "five_joints" / "assembly.svg").read_text().startswith("<svg")


def test_the_published_code_is_an_arm_and_comes_back(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    code = "00001 0·01·10·100·00 0·00·01·111·10 0·00·01·111·10 0·10·11·111·10 0·01·00·110·01"
    spec = tmp_path / "spec.yaml"
    spec.write_text(f"modcal_assembly: 1\nname: published\ncode: {code}\n")
    assert run(["assemble", str(spec), "--out", str(tmp_path / "arm")]) == 0
    assert f"code: {code}" in capfd.readouterr().out
    made = yaml.safe_load((tmp_path / "arm" / "assembly.yaml").read_text())
    assert " ".join(m["module"] for m in made["modules"]) == "B JR LR-I JR LP JR LP JR LR-II JR LC G"
    spec.write_text(yaml.safe_dump({**made, "code": code[:-2] + "10"}))
    assert run(["assemble", str(spec), "--out", str(tmp_path / "other")]) == 2
    assert "modules and code differ from module 12 on" in capfd.readouterr().err


def test_a_library_of_ones_own(tmp_path: Path) -> None:
    mine = yaml.safe_load(published_text())
    mine["modules"]["G"]["output"]["xyz"] = [0, 0, 0.2]
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(mine))
    spec = yaml.safe_load((EXAMPLES / "five_joints.yaml").read_text())
    (tmp_path / "spec.yaml").write_text(yaml.safe_dump({**spec, "library": "mine.yaml"}))
    for arguments in (["spec.yaml"], ["plain.yaml", "--library", str(tmp_path / "mine.yaml")]):
        (tmp_path / "plain.yaml").write_text(yaml.safe_dump(spec))
        out = tmp_path / arguments[0].removesuffix(".yaml")
        assert run(["assemble", str(tmp_path / arguments[0]), *arguments[1:], "--out", str(out)]) == 0
        nominal = chain_of(five_joints(), LIBRARY)
        longer = se3.inverse(nominal.home) @ read_chain((out / "robot.urdf").read_text()).home
        assert np.abs(longer - se3.transform(p=[0, 0, 0.08])).max() < 1e-14


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("modules: [", "is not YAML"),
        ("[]", "is not a mapping"),
        ("{modcal_assembly: 1, modules: [{module: B}, {module: JR}, {module: LC}]}", "it ends in a link"),
        ("{modcal_assembly: 1, library: none.yaml, modules: []}", "library none.yaml: is not beside it"),
    ],
)
def test_refusals(text: str, words: str, tmp_path: Path, refused: Refused) -> None:
    (tmp_path / "spec.yaml").write_text(text)
    refused(["assemble", str(tmp_path / "spec.yaml"), "--out", str(tmp_path / "out")], words)


def bag(folder: Path, assembly: Assembly, arm: Arm, rng: np.random.Generator, stations: int = 60) -> Path:
    """A recording of these many stations, read by the tracker."""
    q = rng.uniform(-2.0, 2.0, (stations, assembly.n))
    t = 1.7e9 + 2.0 * np.arange(len(q))
    readings = ReadingTrack("point", "tracker", t, arm.readings(q, rng), t)
    write_recording(
        Recording(
            (joint_track(assembly.joint_names, t, q),),
            (readings,),
            robot_description=None,
            source="made",
        ),
        folder,
    )
    return folder


def test_from_recordings_to_a_better_start(
    tmp_path: Path, rng: np.random.Generator, capsys: pytest.CaptureFixture[str]
) -> None:
    """The bag's own assembly, built again from what was learned of it, is nearer the truth than the drawing."""
    assembly, library = read_assembly(EXAMPLES / "five_joints.yaml")
    made = Made()
    shelf = shelf_of(assembly.modules, made, rng)
    arm = Arm(assembly, shelf, made, rng)
    store = tmp_path / "modules.yaml"
    one = bag(tmp_path / "bag", assembly, arm, rng)
    assert run(["modules", "learn", str(EXAMPLES / "five_joints.yaml"), str(one), "--modules", str(store)]) == 0
    assert (
        run(["assemble", str(EXAMPLES / "five_joints.yaml"), "--modules", str(store), "--out", str(tmp_path / "arm")])
        == 0
    )
    said = capsys.readouterr().out
    assert "9 of 12 modules are known" in said
    assert "not known: B1, C1, G1" in said  # one with where the base stands and where the ball sits
    learned = read_chain((tmp_path / "arm" / "robot.urdf").read_text())
    nominal = chain_of(assembly, library)

    def spread(chain: object) -> float:
        """How far poses miss when the last posture's pose is made to fit, so that base and tool drop out."""
        q = np.random.default_rng(3).uniform(-1.0, 1.0, (40, 5))
        A, T = chain_forward(chain, q), arm.poses(q)  # type: ignore[arg-type]
        gap = se3.inverse(A[:1]) @ A @ se3.inverse(se3.inverse(T[:1]) @ T)
        return float(np.linalg.norm(se3.log(gap)[:, :3], axis=1).mean())

    assert spread(learned) < spread(nominal)
    # the same recording again changes nothing; the same name for another arm is refused
    before = store.read_text()
    again = ["modules", "learn", str(EXAMPLES / "five_joints.yaml"), str(one), "--modules", str(store)]
    assert run([*again, "--json"]) == 0
    assert store.read_text() == before
    told = json.loads(capsys.readouterr().out)
    assert (told["stations"], told["as_known"], told["notes"]) == (60, True, [])
    stored = twists_from_data(yaml.safe_load(before), "store")
    assert {(part["serial"], part["part"]) for part in told["parts"]} == set(stored)
    assert all(np.allclose(part["twist"], stored[part["serial"], part["part"]]) for part in told["parts"])
    # a flange that was bent since is not learned unless somebody says so
    arm.bolts[3] = arm.bolts[3] @ se3.exp([0.008, 0.0, 0.0, 0.0, 0.0, 0.0])
    bent = bag(tmp_path / "bent", assembly, arm, rng)
    rebuilt = tmp_path / "rebuilt.yaml"
    rebuilt.write_text(yaml.safe_dump({**assembly_to_data(assembly, library), "name": "rebuilt"}))
    again = ["modules", "learn", str(rebuilt), str(bent), "--modules", str(store)]
    assert run(again) == 2
    assert "is not as its modules were known" in capsys.readouterr().err
    assert store.read_text() == before
    assert run([*again, "--accept", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["as_known"] is False
    assert store.read_text() != before
    store.write_text(before)
    other = assembly_to_data(numbered(five_joints(), [m.serial for m in reversed(assembly.modules)]), library)
    (tmp_path / "other.yaml").write_text(yaml.safe_dump({**other, "name": "five_joints"}))
    assert run(["modules", "learn", str(tmp_path / "other.yaml"), str(one), "--modules", str(store)]) == 2
    assert "is a different assembly in this store" in capsys.readouterr().err
    assert store.read_text() == before


def test_other_verbs_take_the_robot(tmp_path: Path, rng: np.random.Generator) -> None:
    """Assembled, recorded, calibrated: the corrected URDF is the assembled one with other origins."""
    assembly, _ = read_assembly(EXAMPLES / "five_joints.yaml")
    arm = Arm(assembly, shelf_of(assembly.modules, Made(), rng), Made(), rng)
    one = bag(tmp_path / "bag", assembly, arm, rng, 100)
    assert run(["assemble", str(EXAMPLES / "five_joints.yaml"), "--out", str(tmp_path / "arm")]) == 0
    urdf = str(tmp_path / "arm" / "robot.urdf")
    assert run(["info", str(one), "--urdf", urdf]) == 0
    assert run(["calibrate", str(one), "--urdf", urdf, "--geometry-only", "--out", str(tmp_path / "out")]) == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    error = report["error_mm"]
    assert error["final"]["mean"] < 0.06 < 0.25 * error["nominal"]["mean"]
    assert report["identifiability"]["rank"] == 4 * 5 + 3
    before, after = (Path(p).read_text().splitlines() for p in (urdf, tmp_path / "out" / "calibrated.urdf"))
    differing = [a for a, b in zip(before, after, strict=True) if a != b]
    assert differing
    assert all("<origin" in line for line in differing)


TARGETS = [
    {"name": f"p{k}", "position_m": p, "mask": "000111"} for k, p in enumerate(([0.3, 0.2, 0.4], [-0.25, 0.25, 0.45]))
]
TASK: dict[str, Any] = {
    "modcal_synthesis": 1,
    "name": "near",
    "targets": TARGETS,
    "requirements": {"joint_range": {}},
    "search": {"population": 48, "generations": 6, "patience": 1},
    "listed": 2,
}


def written(folder: Path, **changes: Any) -> Path:
    path = folder / "near.yaml"
    path.write_text(yaml.safe_dump({**TASK, **changes}))
    return path


def test_from_a_task_to_a_robot(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    library = tmp_path / "mine.yaml"
    library.write_text(published_text().replace("name: published", "name: mine"))
    out = tmp_path / "out"
    arguments = ["--library", str(library), "--workers", "1", "--out", str(out)]
    assert run(["synthesize", str(written(tmp_path)), *arguments]) == 0
    told = capfd.readouterr()
    assert "meet every requirement" in told.out
    assert told.err == ""
    assert {p.name for p in out.iterdir()} == {
        "best.yaml", "library.yaml", "ranking.json", "ranking.md", "best_target_1.svg", "best_target_2.svg", "rank_1.svg", "rank_2.svg",
    }  # fmt: skip
    ranking = json.loads((out / "ranking.json").read_text())
    assert (ranking["task"], ranking["library"], ranking["joints"], len(ranking["ranking"])) == ("near", "mine", 3, 2)
    assert ranking["ranking"][0]["targets"][0]["position_error_m"] < 1e-6
    assert run(["assemble", str(out / "best.yaml"), "--out", str(tmp_path / "robot")]) == 0
    assert (tmp_path / "robot" / "robot.urdf").is_file()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"targets": []}, "targets: it has 0 entries"),
        ({"modules": ["JR"]}, "there is no link among them"),
        ({"targets": [{"position_m": [0, 0, 9], "mask": "000111"}], "joints": {"last": 3}}, "near: none of .* misses a target"),
    ],
)  # fmt: skip
def test_what_comes_to_nothing(changes: dict[str, Any], words: str, tmp_path: Path, refused: Refused) -> None:
    task = str(written(tmp_path, **changes))
    refused(["synthesize", task, "--workers", "1", "--out", str(tmp_path / "out")], words)
