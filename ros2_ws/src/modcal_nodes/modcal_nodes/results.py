"""The files that a calibration leaves behind, as the command and the calibrator node both write them."""

from __future__ import annotations

from modcal_core.calibration.store import to_data
from modcal_core.loop import Result
from modcal_core.report.html import to_html
from modcal_core.report.report import Report, to_json_data
from modcal_core.robots.chain import Chain
from modcal_core.robots.urdf import joint_origins
from modcal_core.robots.urdf_write import calibrated_urdf
from modcal_core.robots.vendor import kinematics_yaml_data
from modcal_nodes.files import to_json, to_yaml


def calibration_files(result: Result, report: Report, nominal: Chain, urdf: str) -> dict[str, str]:
    """Names and texts of everything a calibration leaves behind."""
    calibrated = result.calibration.calibrated.chain
    corrected = calibrated_urdf(urdf, nominal, calibrated)
    return {
        **report_files(report),
        "calibration.yaml": to_yaml(to_data(result.calibration)),
        "calibrated.urdf": corrected,
        "kinematics.yaml": to_yaml(kinematics_yaml_data(calibrated, joint_origins(corrected))),
    }


def report_files(report: Report) -> dict[str, str]:
    """Names and texts of a report."""
    return {"report.json": to_json(to_json_data(report)), "report.html": to_html(report)}
