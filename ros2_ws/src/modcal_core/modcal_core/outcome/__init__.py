"""What a calibration or an evaluation comes to, as data: errors, findings, offsets of joints, notes."""

# ruff: noqa: I001

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_core.outcome.contents import STAGES, Outcome, Step, Trace, iso_date
    from modcal_core.outcome.entries import Finding, at_tool, findings, load_findings, parameters
    from modcal_core.outcome.joint_offsets import offsets_of
    from modcal_core.outcome.entries import counted, description_note, instrument_notes, load_notes, moved_note
    from modcal_core.outcome.entries import not_asked_note, one_instrument_notes, readmitted_note, residual_notes
    from modcal_core.outcome.entries import stated_note, unproved_note, unseen_note
    from modcal_core.outcome.joint_offsets import ToolDifference, tool_difference
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)
