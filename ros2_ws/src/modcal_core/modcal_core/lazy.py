"""Faces of packages: a name is imported when it is first asked for (PEP 562): a verb loads only what it uses."""

from __future__ import annotations

import ast
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any


def lazy_face(package: str, file: str) -> Callable[[str], Any]:
    """The ``__getattr__`` of a package; its ``__init__.py``, ``file``, imports the names under ``if TYPE_CHECKING``.

    They are ``__all__``, where that is not written down.
    """
    modules: dict[str, str] = {}

    def get(name: str) -> Any:
        if not modules:
            modules.update(_names(Path(file).read_text(encoding="utf-8")))
        if name == "__all__":
            return sorted(modules)
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        try:
            return getattr(import_module(modules[name]), name)
        except AttributeError as error:  # `from package import name` would hide what went wrong
            raise ImportError(f"{package}.{name}: {error}") from error

    return get


def _names(source: str) -> dict[str, str]:
    """The module of each name that is imported for the type checker."""
    blocks = [node for node in ast.parse(source).body if isinstance(node, ast.If)]
    imports = [node for block in blocks for node in block.body if isinstance(node, ast.ImportFrom)]
    return {alias.name: str(node.module) for node in imports for alias in node.names}
