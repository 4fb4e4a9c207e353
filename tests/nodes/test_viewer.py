"""The live view as processes: arrows as long as MuJoCo's tool is off, and nothing where nothing is known."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cells import NOISE_M, record
from cli.recordings import START, URDF
from modcal_interfaces.msg import Calibration, Change
from nodes.beside_a_cell import PANDA, stations
from nodes.cell import PlayedCell, call
from nodes.corrected_arm import AWAY, CHAIN, Arm, calibration, message
from nodes.processes import Process, beside, fresh_domain, listener, running
from nodes.talking import LATCHED, Diagnostics
from nodes.test_watch import watched
from nodes.viewed import Pictures
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from modcal_core.correction.picture import joint_axes
from modcal_core.geometry import se3
from modcal_core.geometry.so3 import Array
from modcal_core.measurements.recording import Recording

pytestmark = pytest.mark.dds
SCALE, SHOWN, SEED = 200.0, 24, 1
CALIBRATION, VIEW = "/viewer: calibration", "/viewer: view"


# The recordings' arm is written in DH, whose base is the URDF's base_link turned by half a turn about z
T_URDF_DH = np.diag([-1.0, -1.0, 1.0, 1.0])


def in_base(recording: Recording, T_tracker_base: Array) -> Array:
    """Where the tracker saw the tool, in the true base link (N, 3)."""
    seen = recording.readings[0].values[:, :3]
    return se3.apply(T_URDF_DH @ se3.inverse(T_tracker_base), seen)


def test_arrows_are_as_long_as_the_tool_is_off(tmp_path: Path) -> None:
    """Before a calibration nothing; then the nominal arm's millimetres beside noise; then the bump, to scale."""
    bump = se3.exp(np.array([5e-4, -4e-4, 3e-4, 0.0, 0.0, 0.0]))
    world = record(SEED, 1).world
    before, after = stations(48, SEED), stations(SHOWN, SEED, START + 1000.0, bump)
    domain = fresh_domain()
    calibrator = Process("calibrator", domain, tmp_path, effects=False, after_change=0)
    viewer = Process("viewer", domain, tmp_path, arrow_scale=SCALE, stations=SHOWN)
    with running(calibrator, viewer), listener(domain) as (node, wait):
        cell, said, seen = PlayedCell(node), Diagnostics(node), Pictures(node)
        wait(lambda: cell.heard() and cell.joints.get_subscription_count() == 2 and VIEW in said.last, 60.0)
        wait(lambda: cell.tracker.get_subscription_count() == 2, 60.0)
        cell.describe(URDF.read_text())
        cell.play(before)
        wait(lambda: seen.dots("waiting") == SHOWN, 60.0)
        assert not seen.last["residuals"]
        assert "no calibration yet" in said.text(CALIBRATION)

        wait(cell.taken, 60.0)
        assert call(node, wait, "calibrator/solve").success
        wait(lambda: len(seen.of("residuals", "calibrated")) == SHOWN, 30.0)
        starts, calibrated = seen.arrows("residuals", "calibrated")
        _, nominal = seen.arrows("residuals", "nominal")
        rms = [float(np.sqrt(np.mean(np.sum((v / SCALE) ** 2, axis=1)))) for v in (calibrated, nominal)]
        # three axes of noise; the calibration has seen these stations
        assert 0.5 < rms[0] / (math.sqrt(3.0) * NOISE_M) < 1.5
        assert rms[1] > 5.0 * rms[0]
        # an arm's base may be said to be a little elsewhere
        assert np.abs(starts - in_base(before, world.T_tracker_base)[-SHOWN:]).max() < 5e-3
        assert seen.of("residuals", "calibrated")[0].header.frame_id == "base_link"
        assert f"1 mm is drawn as {SCALE:g} mm" in seen.text()
        wait(lambda: seen.dots("fitting") == SHOWN and seen.dots("recorded") == 48, 10.0)
        wait(lambda: len(seen.of("uncertainty", "stations")) == SHOWN, 10.0)
        three = 3.0 * np.sqrt(3.0) * NOISE_M * 2.0 * SCALE
        assert all(0.0 < m.scale.x < three for m in seen.of("uncertainty", "stations"))
        # stamps of long ago: nothing of a posture is shown, and that is said
        assert not seen.last["axes"]
        assert not seen.of("uncertainty", "present")
        assert "joint_states" in said.text(VIEW)

        cell.play(after)
        wait(lambda: seen.dots("rejected") == SHOWN, 60.0)
        starts, arrows = seen.arrows("residuals", "calibrated")
        truth = in_base(after, world.T_tracker_base) - in_base(stations(SHOWN, SEED), world.T_tracker_base)
        off = arrows / SCALE - truth
        # noise of this reading and of the one it is compared with, and what the calibration does not know
        assert np.sqrt(np.mean(np.sum(off**2, axis=1))) < 1.5 * math.sqrt(6.0) * NOISE_M
        assert np.abs(np.linalg.norm(arrows, axis=1) / SCALE - np.linalg.norm(bump[:3, 3])).max() < 6.0 * NOISE_M
        wait(lambda: "tool" in seen.text(), 30.0)  # the calibrator's word on what has changed
        for topic in ("joint_states", "tracker/pose"):  # its last word, now that it has heard everything
            heard = f"messages of /{topic}"
            wait(lambda heard=heard: said.value("/calibrator: hearing", heard) == str(48 + SHOWN), 30.0)

        snapshot = watched(domain, tmp_path, "--once", "--json", "--for", "6")
        told = {n["name"]: n for n in snapshot["nodes"]}
        parts = {part["part"]: part for part in told["/calibrator"]["parts"]}
        assert parts["model"]["facts"]["state"] == "suspected"
        assert parts["model"]["message"] == said.text("/calibrator: model")
        assert told["/calibrator"]["level"] == "warn"
        assert told["/calibrator"]["trusted"] is False
        assert told["/calibrator"]["change"]["place"] == "tool"
        assert told["/calibrator"]["residual_m"] < 5.0 * NOISE_M
        assert len(told["/calibrator"]["estimate"]) == 5
        assert told["/viewer"]["parts"][1]["message"] == "in use"
        assert not seen.faults
        assert calibrator.stop() == 0
        assert viewer.stop() == 0


def test_the_posture_is_shown_while_it_is_known(tmp_path: Path) -> None:
    """Hostile joint states, messages that are no calibration, another robot's: all said, nothing wrong drawn."""
    made = calibration()
    # calibrator/calibration is played under the name that the arm of the corrector's tests uses
    remap = ("-r", "calibrator/calibration:=calibration")
    with beside(tmp_path, "viewer", *remap, arrow_scale=SCALE, timeout_s=1.0, rate_hz=10.0) as (viewer, node, wait):
        arm, said, seen = Arm(node), Diagnostics(node), Pictures(node)
        wait(lambda: len(seen.of("axes", "nominal")) == CHAIN.n, 60.0)
        assert not seen.of("axes", "calibrated")
        assert not seen.of("uncertainty", "present")
        starts, along = seen.arrows("axes", "nominal")
        p, d = joint_axes(CHAIN, AWAY)
        assert np.abs(starts - p).max() < 1e-9
        assert np.abs(along / np.linalg.norm(along, axis=1, keepdims=True) - d).max() < 1e-9

        # what is no calibration, and one of another robot
        arm.calibration.publish(Calibration())
        wait(lambda: "is not a modcal calibration" in said.text(CALIBRATION), 20.0)
        other = replace(made, nominal=replace(made.nominal, chain=calibration(3).calibrated.serial))
        arm.calibration.publish(message(other))
        wait(lambda: "other nominal kinematics" in said.text(CALIBRATION), 20.0)
        assert said.level(CALIBRATION) == 2
        wait(lambda: seen.of("axes", "nominal"), 10.0)
        assert not seen.of("axes", "calibrated")

        arm.calibration.publish(message(made))
        wait(lambda: len(seen.of("axes", "calibrated")) == CHAIN.n and seen.of("uncertainty", "present"), 20.0)
        (present,) = seen.of("uncertainty", "present")
        size = 2.0 * 3.0 * SCALE * made.noise.position  # a calibration without its uncertainty: scatter only
        assert (present.scale.x, present.scale.y, present.scale.z) == pytest.approx((size,) * 3)
        assert said.level(CALIBRATION) == 1

        # numbers that are none: refused, the arm's last posture goes stale and vanishes
        def spoiled(message: JointState) -> list[JointState]:
            short = JointState(header=message.header, name=message.name, position=list(message.position)[:3])
            message.position[2] = math.nan
            return [message, short]

        arm.reshape = spoiled
        wait(lambda: not seen.last["axes"] and not seen.of("uncertainty", "present"), 20.0)
        wait(lambda: said.level(VIEW) == 1 and "positions for 6 names" in said.text(VIEW), 20.0)
        arm.reshape = lambda m: spoiled(m)[:1]
        wait(lambda: said.level(VIEW) == 1 and "position is not finite" in said.text(VIEW), 20.0)
        arm.reshape = lambda m: [m]
        wait(lambda: seen.of("axes", "calibrated") and seen.of("uncertainty", "present"), 20.0)

        # another arm altogether
        arm.description.publish(String(data=PANDA.read_text()))
        wait(lambda: said.level(CALIBRATION) == 2 and not seen.last["axes"], 20.0)
        arm.description.publish(String(data="<robot"))
        wait(lambda: said.level(VIEW) == 1, 20.0)
        assert not seen.faults
        assert viewer.stop() == 0


def test_readings_in_a_frame_that_nobody_calibrated_are_said(tmp_path: Path) -> None:
    """Their stations are not drawn; those in known frames beside them are."""
    made = calibration()
    with beside(tmp_path, "viewer") as (viewer, node, wait):
        cell, said, seen = PlayedCell(node), Diagnostics(node), Pictures(node)
        model = node.create_publisher(Calibration, "calibrator/calibration", LATCHED)
        change = node.create_publisher(Change, "calibrator/change", LATCHED)
        model.publish(message(made))
        change.publish(Change(changed=True, sentence="tool has moved"))
        cell.describe(URDF.read_text())
        wait(lambda: cell.heard() and "scatter only" in said.text(CALIBRATION), 60.0)

        def some_elsewhere(i: int, message: Any) -> Any:
            if hasattr(message, "pose") and i % 3 == 0:
                message.header.frame_id = "camera"
            return message

        cell.play(stations(12), some_elsewhere)
        wait(lambda: "frame 'camera' are not shown" in said.text(VIEW), 30.0)
        wait(lambda: len(seen.of("residuals", "calibrated")) == 8, 30.0)
        assert "tool has moved" in seen.text()
        assert call(node, wait, "viewer/reset").success
        wait(lambda: not seen.last["residuals"], 20.0)
        assert not seen.faults
        assert viewer.stop() == 0
