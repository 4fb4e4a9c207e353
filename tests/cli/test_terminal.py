"""What comes out of a file is printed, and does not steer the terminal."""

from __future__ import annotations

from pathlib import Path

import pytest
from msgs import bag_forms as forms
from rich.table import Table

from modcal_core.errors import BadRecording, plain
from modcal_nodes.cli.console import Terminal
from modcal_nodes.cli.main import run

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
