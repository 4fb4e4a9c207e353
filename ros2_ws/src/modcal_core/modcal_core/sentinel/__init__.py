"""Has the arm changed? Ordinary recordings beside those of a reference period, without an instrument.

cells: what a recording says, averaged over short cells. channels: signals as linear models of the joints' motion, and
how each change of the arm would show in them. normal: what is normal, and how much it scatters within a recording and
from one to the next. judging: which change explains later recordings. history: all of it on disk.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_core.sentinel.cells import LEAST_SECONDS, Cells, MonitoredArm, cells_of
    from modcal_core.sentinel.history import BagHistory
    from modcal_core.sentinel.judging import ArmJudge, ArmVerdict, ChangeEstimate, HeardBag
    from modcal_core.sentinel.normal import Normal
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)
