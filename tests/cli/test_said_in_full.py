"""What a verb says of arm, tables, files and verdict; and what comes out of a file does not steer the terminal."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cells import record, ur10
from msgs import bag_forms as forms
from report.judged import CANNOT, FLOOR, OPEN, WHY, everything
from report.reports import points
from rich.console import Console
from rich.table import Table
from robots.test_urdf import robot, serial

from modcal_core.errors import BadRecording, BadRobot, BadTable, about, plain
from modcal_core.outcome.contents import Outcome
from modcal_core.report.blocks import TableBlock
from modcal_core.report.report import summary
from modcal_core.report.tables import sentence
from modcal_core.verdict.verdict import Row, Verdict
from modcal_nodes.cli.console import Terminal, show
from modcal_nodes.cli.main import run

ROBOTS = Path(__file__).resolve().parents[2] / "examples" / "robots"
TWO = '<link name="torso"/>' + serial("rrrrrrf", "right_", "torso") + serial("rrrrrrf", "left_", "torso")


@pytest.mark.slow
def test_of_two_arms_the_other_one_is_named(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "two.urdf").write_text(robot(TWO))
    asked = ["sensitivity", str(tmp_path / "two.urdf"), "--parameters", "calibration", "--out", str(tmp_path / "out")]
    assert run(asked) == 0
    assert capfd.readouterr().out.startswith("arm: torso → left_7, 6 joints; --tip right_7 for the other arm\n")


@pytest.mark.slow
def test_stages_effects_and_shares_of_a_report_are_explained() -> None:
    blocks = summary(everything())
    tables = [at for at, block in enumerate(blocks) if isinstance(block, TableBlock)]
    assert len(tables) >= 3
    legends = " ".join(block.below for block in blocks[: tables[-2]] if isinstance(block, TableBlock))
    assert all(block.below for block in blocks[: tables[-2]] if isinstance(block, TableBlock))
    for word in ("nominal:", "geometric:", "final:", "driver:", "p:", "error:"):
        assert word in legends


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("odd.yaml", "rows: []\n", "odd.yaml: kinematic table: has no key 'convention': write convention: dh, mdh, cpc"),
        ("odd.yaml", "convention: hayati\n", "odd.yaml: kinematic table: convention 'hayati' is unknown"),
        ("odd.yaml", "convention: dh\n", "odd.yaml: "),
        ("odd.urdf", "<robot name='r'><link name='a'/></robot>", "odd.urdf: link 'a': no moving joint behind it"),
        ("odd.urdf", "no robot", "odd.urdf: robot description"),
    ],
)  # fmt: skip
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


EVIL = "\x1b]0;owned\x07\x1b[2J\x9b31m\u202e[/red][bold]\r\x00"
CONTROLS = set("\x1b\x07\x9b\u202e\r\x00\x7f")


def test_refusals_hold_no_control_characters() -> None:
    said = str(BadRecording(EVIL, EVIL, f"a\n{EVIL}"))
    assert not CONTROLS & set(said)
    assert "\n" not in said
    assert r"\x1b]0;owned\x07" in said
    assert plain("Größe – 1 µm\tx\n") == "Größe – 1 µm\tx\n"


@pytest.mark.parametrize("force", [False, True])
def test_tables_and_lines_are_printed_as_they_are(force: bool, capsys: pytest.CaptureFixture[str]) -> None:
    """With colours as well: the escapes that are left are the console's own."""
    console = Terminal(
        markup=False, emoji=False, width=200, force_terminal=force, color_system="standard" if force else None
    )
    table = Table(box=None, title=EVIL)
    table.add_column(EVIL)
    table.add_row(EVIL)
    console.print(table)
    console.print(EVIL, style="yellow", highlight=False)
    out = capsys.readouterr().out
    assert not (CONTROLS - {"\x1b"}) & set(out)
    assert "\x1b]" not in out
    assert "\x1b[2J" not in out
    assert out.count("[/red][bold]") == 4
    assert ("\x1b[33m" in out) == force
    assert force or "\x1b" not in out


def test_names_in_a_bag(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Frames, joints, topics, notes and links of a bag that was made to be looked at."""
    c = forms.cell(12)
    evil = EVIL.replace("\x00", "")  # which no message can hold
    messages = [
        *forms.joints(forms.Cell(c.stamps, (*c.names[:5], evil), c.q, c.poses, c.urdf)),
        *forms.readings(c, frame=evil), *forms.readings(c, f"/{evil}/tracker/point", forms.POINT, frame=evil),
        forms.text("/modcal/notes", evil, c.stamps[0]), forms.text("/robot_description", f"<robot name='{evil}'", c.stamps[0]),
    ]  # fmt: skip
    bag = forms.write(tmp_path / "bag", messages)
    for arguments in (["info", str(bag)], ["calibrate", str(bag)], ["articulate", str(bag), "--topic", evil], ["info", evil],
                      ["info", str(bag), "--topic", f"tracker/pose={evil}"], ["repair", str(bag)]):  # fmt: skip
        assert run(arguments) in (0, 2)
        out = "".join(capfd.readouterr())
        assert out
        assert not CONTROLS & set(out), (arguments, out)
        assert "Traceback" not in out


def shown(report: Outcome, colours: bool = False) -> str:
    text = io.StringIO()
    plain = Console(
        file=text, width=300, force_terminal=colours, color_system="standard", markup=False, highlight=False
    )
    show(summary(report), plain)
    return text.getvalue()


@pytest.mark.parametrize(("verdict", "colour"), [(FLOOR, "32"), (OPEN, "31"), (CANNOT, "33"), (None, "33")])
def test_green_only_at_the_floor(verdict: Verdict | None, colour: str) -> None:
    report = replace(points(), judged=verdict)
    words = sentence(report)[:40]
    assert f"\x1b[1;{colour}m{words}" in shown(report, colours=True)


@pytest.mark.slow
def test_the_account_every_reason_and_the_tolerance() -> None:
    said = shown(everything())
    for reason in WHY:
        assert said.count(reason.sentence) >= 1
    assert "account of the squared error" in said
    assert "gear_harmonic elbow_joint" in said
    assert "CANNOT TELL: The tool's error over the recorded ranges (95th percentile) is" in said


def test_small_rows_of_the_account_stand_together() -> None:
    small = tuple(Row(f"effect:gear_harmonic joint_{k}", 0.01) for k in range(5))
    rows = (Row("geometry", 7.5), Row("effect:compliance elbow_joint", 0.5), *small)
    said = shown(replace(points(), judged=replace(OPEN, account_mm2=rows)))
    assert "compliance elbow_joint" in said
    assert "gear_harmonic" not in said
    (together,) = [line.split() for line in said.splitlines() if "5 effects of less than 1%" in line]
    assert together[-4] == "0.05"
    few = shown(replace(points(), judged=replace(OPEN, account_mm2=rows[:4])))
    assert "gear_harmonic joint_1" in few
    assert "effects of less than" not in few


def test_a_floor_that_is_not_known_is_not_zero() -> None:
    said = shown(points())
    lines = [line for line in said.splitlines() if line.startswith(("repeatability", "instrument"))]
    assert len(lines) == 2
    assert all(line.rstrip().endswith("not known") for line in lines)
