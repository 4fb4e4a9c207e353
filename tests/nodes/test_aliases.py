"""Parameters under the names of release 0.1 are read, said to be old, and come after those under the new names."""

from __future__ import annotations

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from nodes.in_process import spun
from rclpy.exceptions import InvalidParameterValueException

from modcal_nodes.nodes.calibrator import Calibrator
from modcal_nodes.nodes.impedance_setpoint import ImpedanceSetpoint
from modcal_nodes.ros.aliases import OLD_NAMES
from modcal_nodes.ros.parameters import NODES


def test_every_old_name_has_a_parameter_and_none_hides_one() -> None:
    names = {name for parameters in NODES.values() for name in parameters}
    assert set(OLD_NAMES) <= names
    assert not set(OLD_NAMES.values()) & names
    assert len(set(OLD_NAMES.values())) == len(OLD_NAMES)
    assert not [name for name in names if name.startswith(("most_", "least_", "wander"))]


@pytest.mark.dds
def test_an_old_name_counts_and_is_said(capfd: pytest.CaptureFixture[str]) -> None:
    with spun(ImpedanceSetpoint, most_force_n=33.0, stale_s=0.25, slow_force_n=9.0, slowdown_force_n=8.0) as pair:
        node = pair.node
        assert node.get_parameter("max_force_n").value == 33.0
        assert node.get_parameter("timeout_s").value == 0.25
        assert node.get_parameter("slowdown_force_n").value == 8.0
        assert not node.has_parameter("most_force_n")
    said = capfd.readouterr().err
    assert "parameter most_force_n is called max_force_n now" in said
    assert "parameter stale_s is called timeout_s now" in said
    assert "hand_n_m" not in said


@pytest.mark.dds
def test_bounds_hold_under_an_old_name() -> None:
    with pytest.raises(InvalidParameterValueException, match="max_stations"), spun(Calibrator, most_stations=1):
        pass


@pytest.mark.dds
def test_a_misspelt_parameter_is_said_with_the_one_that_is_meant(capfd: pytest.CaptureFixture[str]) -> None:
    """In the log and on /diagnostics; what is known is not."""
    given = {"max_forse_n": 33.0, "colour": "red", "max_moment_nm": 7.0, "use_sim_time": True, "stale_s": 0.2}
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
    with spun(ImpedanceSetpoint, max_force_n=33.0, most_moment_nm=7.0, max_stations=100) as pair:
        assert not pair.node.parameters_without_effect
