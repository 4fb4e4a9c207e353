"""Files in and out: calibrations, cells, reports, results."""

# ruff: noqa: I001

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_nodes.io.inputs import read_assembly, read_library
    from modcal_nodes.io.inputs import calibration_of, of_cell, read_calibration, read_cell, read_delta
    from modcal_nodes.io.inputs import read_particulars, read_topics, stated_from
    from modcal_nodes.io.options import ChainOptions, FrozenOptions, Options, SplitOptions, TopicOptions
    from modcal_nodes.io.options import Watch, option, repeated, silent
    from modcal_nodes.io.inputs import calibrate_bag, of_calibrated, opened
    from modcal_nodes.io.options import SCHEMA
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)
