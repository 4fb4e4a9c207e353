"""A target of the fuzzer: a way to make cases, and what is done with one; but for a ModcalError all it raises is a fault."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

ROOT = Path(__file__).resolve().parents[2]
URDF = ROOT / "examples" / "robots" / "ur10.urdf"


@dataclass(frozen=True)
class Target:
    """name; make: a case from random numbers; run: what is done with it."""

    name: str
    make: Callable[[np.random.Generator], Any]
    run: Callable[[Any], None]


def yaml_text(data: Any) -> str:
    """Data as a person writes them; nothing where they cannot be written."""
    try:
        return yaml.dump(data, Dumper=yaml.CDumper, allow_unicode=True)
    except UnicodeEncodeError:
        return "{}"
