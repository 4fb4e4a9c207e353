"""Numbers of the command line: what is none is said in plain words, and what is not finite is none."""

from __future__ import annotations

import re
from collections.abc import Iterable
from math import isfinite
from typing import Any

import click
import numpy as np

from modcal_core.errors import BadTable

_BEGIN = re.compile(r"[+-]?\d+(\.\d+)?")  # of what somebody wrote with a comma or a unit


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


# --- Numbers that somebody gives joint by joint, by name: ``elbow_joint=1.2``


def numbers_by_joint(said: Iterable[str], option: str) -> dict[str, float]:
    """JOINT=NUMBER texts as numbers by joint; empty ones are passed over. Raises BadTable, naming the option."""
    out: dict[str, float] = {}
    for text in filter(None, said):
        name, _, number = text.partition("=")
        try:
            out[name] = float(number)
        except ValueError:
            out[name] = np.nan
        if not name or not np.isfinite(out[name]):
            raise BadTable(f"{option} {text}", "is not JOINT=NUMBER", "write it as elbow_joint=1.2")
    return out
