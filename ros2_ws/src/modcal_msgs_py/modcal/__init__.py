"""The public names of modcal in one place: those of modcal_core, and read_bag.

robot = modcal.Robot.from_urdf("ur10.urdf", tip="tool0")
samples = modcal.Samples.from_arrays(q, points=p)        # or modcal.read_bag("bag").samples(robot)
result = modcal.calibrate(robot, samples, seed=0)
print(result.report)
result.save("out")
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import modcal_core
from modcal_core import __version__

if TYPE_CHECKING:
    from modcal_core import *  # noqa: F403
    from modcal_msgs_py.bag import Bag, read_bag

__all__ = [*modcal_core.__all__, "Bag", "__version__", "read_bag"]


def __getattr__(name: str) -> Any:
    """A public name, imported when it is first asked for (PEP 562)."""
    if name in ("Bag", "read_bag"):
        from modcal_msgs_py import bag

        found = getattr(bag, name)
    elif name in modcal_core.__all__:
        found = getattr(modcal_core, name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    """The public names, and those of a module."""
    return sorted({*globals(), *__all__})
