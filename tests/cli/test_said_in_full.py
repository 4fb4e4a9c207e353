"""What a verb says of the arm it took, of its tables and files, and which file a refusal is about."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from cells import record, ur10
from report.judged import everything
from robots.test_urdf import robot, serial

from modcal_core.errors import BadRobot, BadTable, about
from modcal_core.report.blocks import SummaryLine, TableBlock
from modcal_core.report.terminal import summary
from modcal_nodes.cli.main import run

ROBOTS = Path(__file__).resolve().parents[2] / "examples" / "robots"
TWO = '<link name="torso"/>' + serial("rrrrrrf", "right_", "torso") + serial("rrrrrrf", "left_", "torso")


@pytest.mark.slow
def test_of_two_arms_the_other_one_is_named(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "two.urdf").write_text(robot(TWO))
    asked = ["sensitivity", str(tmp_path / "two.urdf"), "--parameters", "calibration", "--out", str(tmp_path / "out")]
    assert run([*asked, "--design", "sobol", "--postures", "4"]) == 0
    assert capfd.readouterr().out.startswith("arm: torso → left_7, 6 joints; --tip right_7 for the other arm\n")


@pytest.mark.slow
def test_stages_effects_and_shares_of_a_report_are_explained() -> None:
    blocks = summary(everything())
    tables = [at for at, block in enumerate(blocks) if isinstance(block, TableBlock)]
    assert len(tables) >= 3
    for at in tables[:-2]:  # the headings of the accounts explain themselves
        below = next(block for block in blocks[at + 1 :] if isinstance(block, SummaryLine))
        assert below.tone == "legend"
    legends = " ".join(b.text for b in blocks if isinstance(b, SummaryLine) and b.tone == "legend")
    for word in ("nominal:", "geometric:", "final:", "driver:", "p:", "error:"):
        assert word in legends


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        (
            "odd.yaml",
            "rows: []\n",
            "odd.yaml: kinematic table: has no key 'convention': write convention: dh, mdh, cpc",
        ),
        ("odd.yaml", "convention: hayati\n", "odd.yaml: kinematic table: convention 'hayati' is unknown"),
        ("odd.yaml", "convention: dh\n", "odd.yaml: "),
        ("odd.urdf", "<robot name='r'><link name='a'/></robot>", "odd.urdf: link 'a': no moving joint behind it"),
        ("odd.urdf", "no robot", "odd.urdf: robot description"),
    ],
)
@pytest.mark.parametrize("verb", ["sensitivity", "plan"])
def test_a_refusal_names_the_file(
    verb: str, name: str, text: str, said: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / name).write_text(text)
    assert run([verb, str(tmp_path / name)]) == 2
    assert said in capfd.readouterr().err


def test_a_file_is_named_once() -> None:
    with pytest.raises(BadRobot, match=r"^a\.urdf: link b: c: d$"), about("a.urdf"):
        raise BadRobot("link b", "c", "d")
    with pytest.raises(BadTable, match=r"^a\.yaml, row 3: c: d$"), about("a.yaml"):
        raise BadTable("a.yaml, row 3", "c", "d")


def test_what_was_imported_is_put_right_in_its_mapping(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Joint positions in degrees whose mapping says that they are radians."""
    samples, names = record(1, 30).samples, ur10().names
    rows = np.c_[np.degrees(samples.q), samples.reading]
    np.savetxt(tmp_path / "t.csv", rows, delimiter=",", header=",".join((*names, "x", "y", "z")), comments="")
    columns = ", ".join(f"{name}: {name}" for name in names)
    (tmp_path / "map.yaml").write_text(
        "tables: [{files: t.csv, time: {order: {period_s: 10}}, joints: {unit: rad, columns: {"
        + columns
        + "}}, point: {frame: t, unit: m, position: [x, y, z]}}]"
    )
    bag = str(tmp_path / "bag")
    assert run(["import", str(tmp_path / "map.yaml"), "--urdf", str(ROBOTS / "ur10.urdf"), "--out", bag]) in (0, 2)
    first = capfd.readouterr().err
    if not first:
        assert run(["calibrate", bag, "--geometry-only"]) == 2
        first = capfd.readouterr().err
    assert "looks like degrees: correct the unit of joints in map.yaml, and import again" in first
