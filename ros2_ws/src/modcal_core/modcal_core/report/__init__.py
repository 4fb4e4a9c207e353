"""Output for people and programs: JSON, pictures, pages."""

# ruff: noqa: I001

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from modcal_core.report.articulation import URDF, Articulation, articulation_report
    from modcal_core.report.blocks import Page, Quantity, Scene3D, Section, Summary, SummaryLine, TableBlock, Tone
    from modcal_core.report.blocks import VerbResult, explained, quantity_tables
    from modcal_core.report.camera import camera_report
    from modcal_core.report.certificates import Hashes, camera_certificate, camera_tolerance, certificate
    from modcal_core.report.checkup import checkup_data, checkup_report, sentinel_report
    from modcal_core.report.comparison import History, HistoryEntry, Side, compare, history_report
    from modcal_core.report.limits import LimitsFound, limits_report
    from modcal_core.report.particulars import Particulars
    from modcal_core.report.report import Report, calibration_files, kinematics_text, report_files, summary
    from modcal_core.report.report import to_json_data
    from modcal_core.report.sensitivity import plan_report, sensitivity_report
    from modcal_core.report.tables import REMEDY, STATUS_WORDS, csv_text, sentence, short_status
else:
    from modcal_core.lazy import lazy_face

    __getattr__ = lazy_face(__name__, __file__)
