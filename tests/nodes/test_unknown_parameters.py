"""Parameters that nobody knows are said, with the one that is meant."""

from __future__ import annotations

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from nodes.in_process import spun

from modcal_nodes.nodes.impedance_setpoint import ImpedanceSetpoint


@pytest.mark.dds
def test_a_misspelt_parameter_is_said_with_the_one_that_is_meant(capfd: pytest.CaptureFixture[str]) -> None:
    """In the log and on /diagnostics; what is known is not."""
    given = {"max_forse_n": 33.0, "colour": "red", "max_moment_nm": 7.0, "use_sim_time": True, "timeout_s": 0.2}
    said = "parameters without effect: colour is not known; max_forse_n is not known, max_force_n is"
    with spun(ImpedanceSetpoint, **given) as pair:
        heard: list[DiagnosticStatus] = []
        pair.partner.create_subscription(DiagnosticArray, "/diagnostics", lambda m: heard.extend(m.status), 50)
        pair.wait(lambda: any(one.name.endswith(": parameters") for one in heard), 10.0)
        status = next(one for one in heard if one.name.endswith(": parameters"))
        assert status.level == DiagnosticStatus.WARN
        assert said in status.message
    assert said in " ".join(capfd.readouterr().err.split())


@pytest.mark.dds
def test_parameters_that_are_known_are_not_spoken_of() -> None:
    """Nor those of another node: a file under /** gives all nodes all parameters."""
    with spun(ImpedanceSetpoint, max_force_n=33.0, max_stations=100) as pair:
        assert not pair.node.parameters_without_effect
