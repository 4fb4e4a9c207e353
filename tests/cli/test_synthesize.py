"""``modcal synthesize``: files that the other verbs take, and one line where there is nothing to be found."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import yaml
from cli.conftest import Refused

from modcal_core.modules.library import published_text
from modcal_nodes.cli.main import run

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


@pytest.mark.slow
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
        (
            {"targets": [{"position_m": [0, 0, 9], "mask": "000111"}], "joints": {"last": 3}},
            "near: none of .* misses a target",
        ),
    ],
)
def test_what_comes_to_nothing(changes: dict[str, Any], words: str, tmp_path: Path, refused: Refused) -> None:
    task = str(written(tmp_path, **changes))
    refused(["synthesize", task, "--workers", "1", "--out", str(tmp_path / "out")], words)
