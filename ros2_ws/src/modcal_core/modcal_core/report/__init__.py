"""Output for people and programs: JSON, pictures, pages."""

# ruff: noqa: I001

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_core.report.articulation import Articulation, articulation_data, articulation_html
    from modcal_core.report.as_json import to_json_data
    from modcal_core.report.camera import camera_files, camera_report, lines
    from modcal_core.report.camera_page import camera_certificate, camera_tolerance
    from modcal_core.report.certificates import Hashes, certificate, certificate_html, is_made_from
    from modcal_core.report.checkup import History, HistoryEntry, checkup_data, checkup_html, checkup_summary
    from modcal_core.report.checkup import history_data, history_summary
    from modcal_core.report.comparison import Side, compare, comparison_data, comparison_summary
    from modcal_core.report.contents import Step, Trace, iso_date
    from modcal_core.report.diagnosis_entries import findings, load_findings, load_notes, residual_notes
    from modcal_core.report.joint_offsets import offsets_of
    from modcal_core.report.limits import LimitsFound, joint_limits, limits_data, limits_html
    from modcal_core.report.particulars import Particulars
    from modcal_core.report.planning import figure, plan_sentences, planning_html, to_csv, to_plan_data
    from modcal_core.report.planning import to_trajectory_data
    from modcal_core.report.report import Report, calibration_files, delta_files, report_files
    from modcal_core.report.sensitivity import pictures, sensitivity_data, sensitivity_html, sensitivity_sentences
    from modcal_core.report.sensitivity import single_csv, to_text
    from modcal_core.report.sentence import REMEDY, STATUS_WORDS, counted, description_note, instrument_notes
    from modcal_core.report.sentence import moved_note, not_asked_note, readmitted_note, short_status, unseen_note
    from modcal_core.report.terminal import SummaryLine, SummaryTable, Tone, summary
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)

__all__ = ["REMEDY", "STATUS_WORDS", "Articulation", "Hashes", "History", "HistoryEntry", "LimitsFound"]
__all__ += ["Particulars", "Report", "Side", "Step", "SummaryLine", "SummaryTable", "Tone", "Trace"]
__all__ += ["articulation_data", "articulation_html", "calibration_files", "camera_certificate", "camera_files"]
__all__ += ["camera_report", "camera_tolerance", "certificate", "certificate_html", "checkup_data", "checkup_html"]
__all__ += ["checkup_summary", "compare", "comparison_data", "comparison_summary", "counted", "delta_files"]
__all__ += ["description_note", "figure", "findings", "history_data", "history_summary", "instrument_notes"]
__all__ += ["is_made_from", "iso_date", "joint_limits", "limits_data", "limits_html", "lines", "load_findings"]
__all__ += ["load_notes", "moved_note", "not_asked_note", "offsets_of", "pictures", "plan_sentences", "planning_html"]
__all__ += ["readmitted_note", "report_files", "residual_notes", "sensitivity_data", "sensitivity_html"]
__all__ += ["sensitivity_sentences", "short_status", "single_csv", "summary", "to_csv", "to_json_data", "to_plan_data"]
__all__ += ["to_text", "to_trajectory_data", "unseen_note"]
