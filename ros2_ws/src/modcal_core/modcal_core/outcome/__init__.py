"""What a calibration or an evaluation comes to, as data: errors, findings, offsets of joints, notes."""

# ruff: noqa: I001

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_core.outcome.contents import STAGES, Outcome, Step, Trace, iso_date
    from modcal_core.outcome.entries import Finding, at_tool, counted, finding_notes, findings, fit_notes, load_findings
    from modcal_core.outcome.entries import load_notes, moved_note, not_asked_note, one_instrument_notes, parameters
    from modcal_core.outcome.entries import readmitted_note, residual_notes, unseen_note
    from modcal_core.outcome.joint_offsets import ToolDifference, offsets_of, tool_difference
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)
