"""Where families come from: the files of ``effects/families``, and what installed packages name as entry points.

Both are read here, without knowing what a family is; :mod:`registry` says what may be one. A package says

    [project.entry-points."modcal.effects"]
    taut_cable = "my_package.taut_cable:FAMILY"
"""

from __future__ import annotations

import pkgutil
from functools import cache
from importlib import import_module
from typing import Any

from modcal_core.effects import families
from modcal_core.measurements.packages import added

GROUP = "modcal.effects"


@cache
def brought() -> tuple[tuple[str, Any], ...]:
    """(how to call it in a message to people, what it names), built-in families first.

    Raises BadTable where a package cannot be loaded.
    """
    names = [module.name for module in pkgutil.iter_modules(families.__path__)]
    order = {name: k for k, name in enumerate(families.ORDER)}
    names.sort(key=lambda name: (order.get(name, len(order)), name))
    files = [(f"effects/families/{name}.py", import_module(f"{families.__name__}.{name}").FAMILY) for name in names]
    return (*files, *added(GROUP))
