"""How verbs are given what they need, and how they speak: results on stdout, or as JSON with ``--json``.

The parser of a verb is made from the dataclass of its options. Progress is shown on stderr where that is a terminal,
and wiped when it is over; ``-v`` writes a line for each stage instead, with the seconds that it took.
"""

from __future__ import annotations

import functools
import os
import re
import time
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import Field, fields
from math import isfinite
from os import PathLike
from pathlib import Path
from typing import Any

import click
from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.table import Table as RichTable
from rich.text import Text

from modcal_core.errors import plain
from modcal_core.report import Summary, SummaryLine, Tone, VerbResult
from modcal_nodes.io import Watch, silent

_BEGIN = re.compile(r"[+-]?\d+(\.\d+)?([eE][+-]?\d+)?")  # of what somebody wrote with a comma or a unit


class _Named(click.Path):
    """A path that is not the empty text, which would be the folder where the command runs."""

    def convert(
        self, value: str | PathLike[str], param: click.Parameter | None, ctx: click.Context | None
    ) -> Any:  # what click declares: a path of path_type
        """The path. Refuses the empty text."""
        if str(value) == "":
            self.fail("is empty, as an unset variable of a script is; name what shall be written", param, ctx)
        return super().convert(value, param, ctx)


class Decimal(click.FloatRange):
    """A finite number within a range."""

    name = "number"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The number, or a refusal that says how to write it."""
        try:
            number = float(value)
        except ValueError:
            begin = _BEGIN.match(str(value).strip().replace(",", "."))
            meant = f": write {begin[0]}" if begin else ""
            self.fail(f"{value!r} is not a number{meant}.", param, ctx)
        if not isfinite(number):
            self.fail(f"{value!r} is not a finite number.", param, ctx)
        return super().convert(number, param, ctx)


class Whole(click.IntRange):
    """A whole number within a range."""

    name = "whole number"


EXISTING = click.Path(exists=True, path_type=Path)
WRITTEN = _Named(path_type=Path)


def given(of: type[Any], name: str = "options", without: Collection[str] = ()) -> Callable[..., Any]:
    """A decorator that hands a command a value of this dataclass, from the command line, under a name.

    without: fields that are no options of this command and keep their defaults.
    """
    mine = [one for one in fields(of) if one.name not in without]

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(command)
        def called(*arguments: Any, **named: Any) -> Any:
            own = {one.name: named.pop(one.name) for one in mine}
            return command(*arguments, **{name: of(**own)}, **named)

        for one in reversed(mine):
            called = _click_option(one)(called)
        return called

    return decorate


def _flags(one: Field[Any]) -> tuple[str, ...]:
    return one.metadata["names"] or (f"--{one.name.replace('_', '-')}",)


def _click_option(one: Field[Any]) -> Callable[..., Any]:
    """Click's option of a field that :func:`modcal_nodes.io.option` has made."""
    more = {key: value for key, value in one.metadata.items() if key != "names"}
    kind = str(one.type).removesuffix(" | None")
    low, high, above = (more.pop(key, None) for key in ("low", "high", "above"))
    if choices := more.pop("choices", None):
        more["type"] = click.Choice(choices)
    elif kind == "bool":
        more["is_flag"] = True
    elif kind == "tuple[str, ...]":
        more["multiple"] = True
    elif "type" not in more and kind != "str":
        ranged = {"int": Whole, "float": Decimal}.get(kind)
        more["type"] = EXISTING if ranged is None else ranged(low if above is None else above, high, above is not None)
    return click.option(one.name, *_flags(one), default=one.default, **more)


UNMET = 3  # exit code: done, but what was asked for is not met, or cannot be told
_WIDE = 160


class Terminal(Console):
    """A console on which nothing that came out of a file can steer the terminal, or is taken for markup."""

    def render_str(self, text: str, **options: Any) -> Text:
        """A text to be laid out, which is as wide as what will be printed."""
        return super().render_str(plain(text), **options)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """The segments of something printed, control characters in its text written out."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(plain(segment.text), segment.style)


def console(stderr: bool = False) -> Console:
    """A console as wide as the terminal; where there is none, wide enough for every table (COLUMNS, if set)."""
    made = Terminal(stderr=stderr, emoji=False, markup=False, highlight=False)
    if not made.is_terminal and "COLUMNS" not in os.environ:
        made.width = _WIDE
    return made


STYLES: dict[Tone, str] = {
    "plain": "",
    "legend": "dim",
    "doubt": "yellow",
    "good": "bold green",
    "bad": "bold red",
    "warn": "bold yellow",
    "reason": "red",
}


def show(blocks: Iterable[str | Summary], console: Console) -> None:
    """Print tables and sentences, each in the colour of its meaning; texts as they are, paths whole."""
    below = ""
    for block in blocks:
        if isinstance(block, str):
            console.print(block, soft_wrap=True)
        elif isinstance(block, SummaryLine):
            console.print(str(block), style=STYLES[block.tone])
        else:
            table = RichTable(box=None, header_style="bold", pad_edge=False)
            for i, name in enumerate(block.top):
                # a name stays whole, and no digit is left out, however narrow the terminal
                table.add_column(name, justify="left" if i < block.words else "right", overflow="fold", no_wrap=i == 0)
            for row in block.rows:
                table.add_row(*row)
            console.print(table)
            if block.below and block.below != below:  # tables one after the other have one legend
                console.print(f"  {block.below}", style=STYLES["legend"])
            below = block.below


def written(folder: Path, names: Iterable[str], what: str = "Report", first: str = "report.html") -> str:
    """The lines that name what a verb has written into a folder. first: the file to look at; what: a word for it."""
    others = ", ".join(sorted(name for name in names if name != first))
    return f"{what}: {folder / first}" + (f"\nAlso in {folder}: {others}" if others else "")


class Output:
    """How one call of a verb speaks. out: where its results go, as it was given."""

    def __init__(self, as_json: bool = False, verbose: bool = False, out: Path | None = None) -> None:
        self._as_json, self.verbose, self.out = as_json, verbose, out
        self._out = console()

    def result(self, data: Any, blocks: Iterable[str | Summary], where: str = "") -> None:
        """Say the result: as JSON data, or as tables and sentences, and then where it is."""
        if self._as_json:
            from modcal_core.files import to_json

            click.echo(to_json(data), nl=False)
            return
        show(blocks, self._out)
        if where:
            click.echo(plain(where))

    def saved(self, result: VerbResult, folder: str | Path, *before: str) -> None:
        """Write the files of a result, whole or not at all, and say it and where it is.

        folder: where, unless ``--out`` names another. before: lines above the result.
        """
        from modcal_core.files import write_folder

        out = self.out or Path(folder)
        write_folder(out, result.files)
        self.result(result.data, [*before, *result.said], written(out, result.files, result.what, result.first))

    @contextmanager
    def working(self) -> Iterator[Watch]:
        """A watch to hand to long work. An interruption goes through."""
        error = console(stderr=True)
        if self.verbose:
            yield from _lines()
        elif error.is_terminal and not self._as_json:
            yield from _bar(error)
        else:
            yield silent


def _lines() -> Iterator[Watch]:
    """A line for each stage, when it ends."""
    now, since = "", time.monotonic()

    def end() -> None:
        if now:
            click.echo(f"{plain(now)}: {time.monotonic() - since:.1f} s", err=True)

    def watch(stage: str, share: float | None = None) -> None:
        nonlocal now, since
        if stage != now:
            end()
            now, since = stage, time.monotonic()

    yield watch
    end()


def _bar(console: Console) -> Iterator[Watch]:
    """One line that changes: what is being done, how much of it, and how long that will take."""
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, TextColumn("left"), TimeRemainingColumn(), console=console, transient=True) as progress:
        bar, now = progress.add_task("", total=None), ""

        def watch(stage: str, share: float | None = None) -> None:
            nonlocal now
            if stage != now:
                progress.reset(bar, description=stage, total=None if share is None else 1.0)
                now = stage
            if share is not None:
                progress.update(bar, total=1.0, completed=share)

        yield watch


def speaking(command: Callable[..., Any]) -> Callable[..., Any]:
    """The command with ``--json`` and ``-v``; it is handed the output that they ask for."""

    @click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
    @click.option("-v", "--verbose", is_flag=True, help="Report on stderr what was done, and how long it took.")
    @functools.wraps(command)
    def spoken(*arguments: Any, as_json: bool, verbose: bool, **options: Any) -> Any:
        return command(*arguments, output=Output(as_json, verbose), **options)

    return spoken


def saving(text: str = "Folder of the results.") -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """A decorator: as ``speaking``, and with ``--out``. text: its help."""

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        @click.option("--out", type=WRITTEN, help=text)
        @speaking
        @functools.wraps(command)
        def saved(*arguments: Any, out: Path | None, output: Output, **options: Any) -> Any:
            output.out = out
            return command(*arguments, output=output, **options)

        return saved

    return decorate
