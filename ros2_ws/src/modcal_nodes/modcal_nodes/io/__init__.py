"""Files in and out: calibrations, cells, reports, results."""

# ruff: noqa: I001

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_nodes.io.recorded import calibrate_bag, of_calibrated, opened
    from modcal_nodes.io.inputs import calibration_of, of_cell, read_assembly
    from modcal_nodes.io.inputs import read_cell, read_delta, read_library, read_particulars
    from modcal_nodes.io.inputs import read_topics, stated_from
    from modcal_nodes.io.options import ChainOptions, FrozenOptions, Options, SplitOptions, TopicOptions, Watch
    from modcal_nodes.io.options import option, repeated, silent
    from modcal_nodes.io.watched import SentinelOptions, judge_arm
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)
