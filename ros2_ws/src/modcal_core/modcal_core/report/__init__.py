"""Output for people and programs: JSON, pictures, pages."""

# ruff: noqa: I001

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_core.report.articulation import Articulation, articulation_data, articulation_html
    from modcal_core.report.as_json import to_json_data
    from modcal_core.report.blocks import Summary, SummaryLine, SummaryTable, Tone, explained
    from modcal_core.report.camera import camera_files, camera_report
    from modcal_core.report.camera_page import camera_certificate, camera_sentences, camera_tolerance
    from modcal_core.report.certificates import Hashes, certificate, certificate_html, is_made_from
    from modcal_core.report.checkup import History, HistoryEntry, checkup_data, checkup_html, checkup_summary
    from modcal_core.report.checkup import history_data, history_summary
    from modcal_core.report.comparison import Side, compare, comparison_data, comparison_summary
    from modcal_core.report.limits import LimitsFound, joint_limits, limits_data, limits_html, limits_summary
    from modcal_core.report.particulars import Particulars
    from modcal_core.report.planning import plan_sentences, planning_html, to_csv, to_plan_data
    from modcal_core.report.planning import to_trajectory_data
    from modcal_core.report.report import Report, calibration_files, delta_files, kinematics_text, report_files
    from modcal_core.report.sensitivity import sensitivity_data, sensitivity_html, sensitivity_summary, single_csv
    from modcal_core.report.words import REMEDY, STATUS_WORDS, sentence, short_status
    from modcal_core.report.terminal import summary
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)

__all__ = ["REMEDY", "STATUS_WORDS", "Articulation", "Hashes", "History", "HistoryEntry", "LimitsFound"]
__all__ += ["Particulars", "Report", "Side", "Summary", "SummaryLine", "SummaryTable", "Tone", "articulation_data"]
__all__ += ["articulation_html", "calibration_files", "camera_certificate", "camera_files", "camera_report"]
__all__ += ["camera_sentences", "camera_tolerance", "certificate", "certificate_html", "checkup_data"]
__all__ += ["checkup_html", "checkup_summary", "compare", "comparison_data", "comparison_summary", "delta_files"]
__all__ += [
    "explained",
    "history_data",
    "history_summary",
    "is_made_from",
    "joint_limits",
    "kinematics_text",
    "limits_data",
]
__all__ += ["limits_html", "limits_summary", "plan_sentences", "planning_html", "report_files", "sensitivity_data"]
__all__ += ["sensitivity_html", "sensitivity_summary", "sentence", "short_status", "single_csv", "summary"]
__all__ += ["to_csv", "to_json_data", "to_plan_data", "to_trajectory_data"]
