"""The parser of a verb, made from the dataclass of its options."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Collection
from dataclasses import Field, fields
from math import isfinite
from os import PathLike
from pathlib import Path
from typing import Any

import click

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
