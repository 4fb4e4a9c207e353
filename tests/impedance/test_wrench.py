"""Forces: the frame does not matter to what they do, weight is told from touch, and bad readings are refused."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from modcal_core.errors import BadCommand
from modcal_core.geometry import se3, so3
from modcal_core.geometry.so3 import Array
from modcal_core.impedance.tare import Tare
from modcal_core.impedance.wrench import DOWN, Load, LowPass, SensorWeighing, WrenchSensor

LOAD = Load(1.3, np.array([0.01, -0.02, 0.06]), np.array([1.0, -2.0, 3.0, 0.1, 0.2, -0.3]))


def hung(R_base_sensor: Array) -> Array:
    """What a sensor says of a mass that hangs on it, from the base's point of view: force and moment of a weight."""
    weight = LOAD.mass * DOWN
    moment = np.cross(R_base_sensor @ LOAD.centre, weight)
    return np.concatenate([R_base_sensor.T @ weight, R_base_sensor.T @ moment]) + LOAD.bias


def test_a_force_does_the_same_work_in_any_frame(rng: np.random.Generator) -> None:
    """Power F · V is the same at the sensor and at the tool, for any motion of the rigid tool."""
    for _ in range(20):
        T_tool_sensor = se3.exp(rng.normal(size=6))
        w, V_tool = rng.normal(size=6), rng.normal(size=6)
        V_sensor = se3.adjoint(se3.inverse(T_tool_sensor)) @ V_tool
        sensor = WrenchSensor([("flange", T_tool_sensor)])
        sensor.receive("flange", w, 1.0, 1.0, 0.1)
        F = sensor.on_tool(se3.exp(rng.normal(size=6)))
        assert F @ V_tool == pytest.approx(w @ V_sensor, abs=1e-12)


def test_sign_of_a_sensor_that_says_what_the_tool_does() -> None:
    sensor = WrenchSensor([("tool", np.eye(4))], sign=-1.0)
    sensor.receive("tool", [0, 0, 5, 0, 0, 0], 1.0, 1.0, 0.1)
    assert np.allclose(sensor.on_tool(np.eye(4)), [0, 0, -5, 0, 0, 0])


def test_a_tare_takes_off_what_is_there_and_known_weight_goes_along(rng: np.random.Generator) -> None:
    """With the mass known, a turned tool is still free of its weight; without, it is off by the weight's turn."""
    T0, T1 = np.eye(4), se3.transform(Rotation.from_euler("x", 60, degrees=True).as_matrix())
    left = {}
    for name, known in (("known", Load(LOAD.mass, LOAD.centre)), ("unknown", Load())):
        sensor, tare = WrenchSensor([("tool", np.eye(4))], known), Tare(0.5)
        done, k = False, 0
        while not done:
            sensor.receive(
                "tool", hung(np.eye(3)) + 0.2 * rng.normal(size=6) * [1, 1, 1, 0.1, 0.1, 0.1], 0.01 * k, 0.01 * k, 1
            )
            done = tare.add(sensor.raw, sensor.stamp, True)
            k += 1
        assert 0.01 * (k - 1) >= 0.5
        sensor.load = tare.load(T0[:3, :3], known)
        sensor.reset_past()
        sensor.receive("tool", hung(T1[:3, :3]), 9.0, 9.0, 1.0)
        left[name] = np.linalg.norm(sensor.on_tool(T1)[:3])
    assert left["known"] < 0.3
    assert left["unknown"] == pytest.approx(LOAD.mass * 9.80665, abs=0.4)  # 60°: a chord as long as the weight


def test_a_tare_waits_for_rest_and_refuses_noise(rng: np.random.Generator) -> None:
    tare = Tare(0.5)
    for k in range(100):
        assert not tare.add(np.zeros(6), 0.01 * k, at_rest=k % 40 != 0)
    noisy = Tare(0.5)
    for k in range(60):
        noisy.add(10.0 * rng.normal(size=6), 0.01 * k, True)
    with pytest.raises(BadCommand, match="scatter"):
        noisy.load(np.eye(3), Load())


def test_the_low_pass_has_its_cutoff() -> None:
    """Half the power of a sine at the cutoff, nearly all far below, little far above."""
    gains = []
    for hz in (0.5, 10.0, 200.0):
        smooth, t = LowPass(10.0), np.arange(0.0, 4.0, 4e-4)
        out = np.array([smooth.take(np.array([np.sin(2 * np.pi * hz * s)]), s + 1.0)[0] for s in t])
        gains.append(np.abs(out[len(out) // 2 :]).max())
    assert gains == pytest.approx([1.0, np.sqrt(0.5), 0.05], abs=0.02)


@pytest.mark.parametrize(
    ("frame", "wrench", "stamp", "said"),
    [
        ("camera", np.zeros(6), 1.0, "frame 'camera'"),
        ("tool", [0, 0, np.nan, 0, 0, 0], 1.0, "not finite"),
        ("tool", [0, np.inf, 0, 0, 0, 0], 1.0, "not finite"),
        ("tool", [0, 0, 0], 1.0, "not finite"),
        ("tool", [1e300, 0, 0, 0, 0, 0], 1.0, "not a plausible reading"),
        ("tool", np.zeros(6), 0.5, "s off"),
        ("tool", np.zeros(6), 1.6, "s off"),
        ("tool", np.zeros(6), np.nan, "s off"),
        ("tool", np.zeros(6), 0.93, "after a newer one"),
    ],
)
def test_bad_readings_are_refused_and_change_nothing(frame: str, wrench: object, stamp: float, said: str) -> None:
    sensor = WrenchSensor([("tool", np.eye(4))])
    sensor.receive("tool", np.ones(6), 0.95, 1.0, 0.1)
    with pytest.raises(BadCommand, match=said):
        sensor.receive(frame, wrench, stamp, 1.0, 0.1)  # type: ignore[arg-type]
    assert (sensor.stamp, *sensor.raw) == (0.95, 1, 1, 1, 1, 1, 1)


@pytest.mark.parametrize("share", [1.0, 0.5, 0.2, -1.0])
def test_a_sensor_is_weighed_by_what_hangs_on_it_as_the_wrist_turns(share: float, rng: np.random.Generator) -> None:
    """Not by a wrist that stands, nor where a hand pushes at it; whatever its zero."""
    weighing, still, pushed = SensorWeighing(), SensorWeighing(), SensorWeighing()
    for angle in np.concatenate([np.zeros(200), np.linspace(0.0, 0.6, 400), np.full(200, 0.6)]):
        R = so3.exp([angle, 0.5 * angle, 0.0])
        raw = np.concatenate([share * 0.7 * R.T @ DOWN + [3.0, -2.0, 1.0], np.zeros(3)]) + 0.2 * rng.standard_normal(6)
        weighing.take(raw, R)
        still.take(raw, np.eye(3))
        pushed.take(raw + [0.0, 0.0, 15.0 * np.sin(40.0 * angle), 0.0, 0.0, 0.0], R)
    told = weighing.scale(0.7)
    assert told is not None
    assert abs(told[0] - share) < 4.0 * told[1] + 0.01
    assert told[1] < 0.05
    assert still.scale(0.7) is pushed.scale(0.7) is weighing.scale(0.0) is None
