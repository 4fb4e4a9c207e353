"""The league: methods of the field on the same recordings and splits, scored on readings that none of them has seen."""

import sys
from pathlib import Path

# modcal as it is in this checkout: no environment of the league has it installed
_SRC = Path(__file__).resolve().parents[1] / "ros2_ws" / "src"
sys.path += [str(_SRC / name) for name in ("modcal_core", "modcal_msgs_py", "modcal_nodes")]
