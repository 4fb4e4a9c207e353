"""Modules that are loaded when something of them is asked for, and not when they are imported.

SciPy copies the names of NumPy, subpackages included, when it is loaded, and with them NumPy loads what builds Fortran
and what tests arrays, a twentieth of a small calibration. Python's own loader for this leaves a module unread until it
is used.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec, PathFinder
from importlib.util import LazyLoader
from types import ModuleType

DEFERRED = ("numpy.f2py", "numpy.ma", "numpy.testing")


class _Finder:
    """Finds the modules that are deferred, and no others."""

    @staticmethod
    def find_spec(name: str, path: Sequence[str] | None = None, target: ModuleType | None = None) -> ModuleSpec | None:
        """Where a module is found, to be read when it is used."""
        spec = PathFinder.find_spec(name, path, target) if name in DEFERRED else None
        if spec is not None and spec.loader is not None:
            spec.loader = LazyLoader(spec.loader)
        return spec


def defer_imports() -> None:
    """Let the modules wait that a verb imports without using them; for a process of its own."""
    if _Finder not in sys.meta_path:
        sys.meta_path.insert(0, _Finder)
