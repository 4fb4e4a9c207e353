"""The parser of a verb, made from the dataclass of its options; and ``--certificate``."""

from __future__ import annotations

import functools
import hashlib
import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import Field, fields, replace
from math import isfinite
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from modcal_core.errors import BadTable
from modcal_core.report import Particulars
from modcal_nodes.io import read_particulars

if TYPE_CHECKING:
    from modcal_core.report import Hashes
    from modcal_core.verdict import Tolerance
    from modcal_nodes.cli.calibrate import CertifiedOptions


UNMET = 3  # exit code: done, but the tolerance is not met or cannot be told


def particulars(options: CertifiedOptions) -> Particulars | None:
    """What is stated for a certificate, before anything is computed; None if none was asked for. Raises BadTable."""
    if not options.certificate:
        if options.serial is not None:
            raise BadTable("--serial", "is printed on a certificate only", "add --certificate")
        return None
    if options.tolerance_mm is None:
        raise BadTable("--certificate", "has no tolerance to judge by", "give --tolerance-mm, e.g. --tolerance-mm 0.2")
    said = read_particulars(options.cell_file)
    return said if options.serial is None else replace(said, serial=options.serial)


def exit_code(met: Tolerance | None) -> int:
    """0 where no tolerance was asked for, or it is met."""
    return 0 if met is None or met.result == "PASS" else UNMET


def certified_hashes(
    description: str | Path | None, calibration: str | Path, images: Sequence[Path | None] = ()
) -> Hashes:
    """SHA-256 of a robot description and a calibration, each a text, or a file (of a folder its calibration.yaml).

    images: folders and files that a calibration by camera was made from; of all of them one, as of a bag of many files.
    """
    from modcal_core.report import Hashes

    if isinstance(calibration, Path) and calibration.is_dir():
        calibration = calibration / "calibration.yaml"
    files = [file for one in images if one is not None for file in (sorted(one.iterdir()) if one.is_dir() else [one])]
    listed = "".join(f"{_digest(file)}  {file.name}\n" for file in files if file.is_file())
    return Hashes(
        recording=_digest(listed) if listed else None,
        description=None if description is None else _digest(description),
        calibration=_digest(calibration),
    )


def _digest(content: str | Path) -> str:
    return hashlib.sha256(content.read_bytes() if isinstance(content, Path) else content.encode()).hexdigest()


_BEGIN = re.compile(r"[+-]?\d+(\.\d+)?")  # of what somebody wrote with a comma or a unit


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
            pointed = str(value).strip().replace(",", ".")
            begin = _BEGIN.match(pointed)
            meant = f": write {pointed if _reads(pointed) else begin[0]}" if begin else ""
            self.fail(f"{value!r} is not a number{meant}.", param, ctx)
        if not isfinite(number):
            self.fail(f"{value!r} is not a finite number.", param, ctx)
        return super().convert(number, param, ctx)


class Whole(click.IntRange):
    """A whole number within a range."""

    name = "whole number"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The number, or a refusal."""
        try:
            number = int(value)
        except ValueError:
            self.fail(f"{value!r} is not a whole number.", param, ctx)
        return super().convert(number, param, ctx)


def _reads(text: str) -> bool:
    try:
        return isfinite(float(text))
    except ValueError:
        return False


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
