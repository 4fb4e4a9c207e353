"""Kinds of paths that verbs are given."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import Any

import click


class _Named(click.Path):
    """A path that is not the empty text, which would be the folder where the command runs."""

    def convert(
        self, value: str | PathLike[str], param: click.Parameter | None, ctx: click.Context | None
    ) -> Any:  # what click declares: a path of path_type
        """The path. Refuses the empty text."""
        if str(value) == "":
            self.fail("is empty, as an unset variable of a script is; name what shall be written", param, ctx)
        return super().convert(value, param, ctx)


EXISTING = click.Path(exists=True, path_type=Path)
WRITTEN = _Named(path_type=Path)
