"""What the calibrator publishes: the trusted model, what was found, and the running estimate."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from rcl_interfaces.msg import Parameter
from std_msgs.msg import Bool, Float64, String

from modcal_core.camera import Moved
from modcal_core.files import parse_yaml
from modcal_core.online import ChangeHypothesis, Estimator
from modcal_core.recalibrate import ModelComparison
from modcal_core.robots import Mechanism
from modcal_msgs_py import fill_calibration, fill_change, fill_checked, fill_estimate, fill_identity, fill_verdict
from modcal_nodes.ros import LATCHED, GuardedNode, interface


class Publishers:
    """The calibrator's publishers. All are latched but the running estimate."""

    def __init__(self, node: GuardedNode) -> None:
        self._node = node
        self._chain: Mechanism | None = None
        self._observers: Callable[[], Sequence[str]] = tuple
        self._types = {name: interface(name) for name in ("Calibration", "Change", "Checked", "Estimate", "Verdict")}
        self._model, self._report, self._change, self._checked = (
            node.create_publisher(self._types[name], topic, LATCHED)
            for name, topic in (
                ("Calibration", "~/calibration"), ("Verdict", "~/report"), ("Change", "~/change"),
                ("Checked", "~/checked"),
            )
        )  # fmt: skip
        self._description = node.create_publisher(String, "~/robot_description", LATCHED)
        self._estimate = node.create_publisher(self._types["Estimate"], "~/estimate", 10)
        self._residual = node.create_publisher(Float64, "~/residual", LATCHED)
        self._before = node.create_publisher(Float64, "~/residual_before", LATCHED)
        self._trusted = node.create_publisher(Bool, "~/trusted", LATCHED)
        self._holds = False  # whether a model is trusted

    def identify(self, chain: Mechanism, observers: Callable[[], Sequence[str]]) -> None:
        """Speak of this arm from now on, as seen in the frames that observers gives at any time."""
        self._chain, self._observers = chain, observers

    def about(self, observers: Sequence[str] = ()) -> str:
        """What an answer is about, in words. observers: frames that led to it; empty: those that are read."""
        told = self._message("Verdict", observers).about
        return f"[robot {told.robot}, {told.base} to {told.tip}, seen by {', '.join(told.observers)}]"

    def hold(self, holds: bool | None = None) -> None:
        """Publish whether a model is trusted; None: as it was, so that who asks is not left waiting for one."""
        self._holds = self._holds if holds is None else holds
        self._trusted.publish(Bool(data=self._holds))

    def _message(self, name: str, observers: Sequence[str] = ()) -> Any:
        message = self._types[name]()
        if hasattr(message, "about"):
            fill_identity(message.about, self._chain, observers or self._observers())
        message.header.frame_id = "" if self._chain is None else self._chain.base
        message.header.stamp = self._node.get_clock().now().to_msg()
        return message

    def model(self, files: Mapping[str, str], calibration: Mapping[str, Any] | None = None) -> None:
        """Publish a model that is trusted from now on. calibration: data of calibration.yaml; None: it is read."""
        if "calibrated.urdf" in files:
            self._description.publish(String(data=files["calibrated.urdf"]))
        if calibration is None and (text := files.get("calibration.yaml")):
            calibration = parse_yaml(text, "calibration.yaml")
        if calibration is not None:
            self._model.publish(fill_calibration(self._message("Calibration"), Parameter, calibration))
        if "report.json" in files:
            self._report.publish(self.verdict(files["report.json"]))
        self.hold(True)

    def verdict(self, report: str, observers: Sequence[str] = ()) -> Any:
        """What the text of a report.json says of its model, as a Verdict. observers: frames that led to it."""
        return fill_verdict(self._message("Verdict", observers), json.loads(report))

    def result(self, rms: float | None, comparison: ModelComparison) -> None:
        """Publish how large the error is on stations that the fit has not seen, and was before [m]."""
        if rms is not None and np.isfinite(rms):
            self._residual.publish(Float64(data=float(rms)))
        if np.isfinite(comparison.before):
            self._before.publish(Float64(data=float(comparison.before)))

    def change(self, hypothesis: ChangeHypothesis) -> None:
        """Publish that something has changed, and what it may be; the model is not to be trusted blindly."""
        self._suspect(
            place=hypothesis.place,
            direction=hypothesis.direction,
            driver=hypothesis.driver,
            since_s=hypothesis.since,
            size_mm=1e3 * hypothesis.size,
            same_as=hypothesis.same_as,
            sentence=hypothesis.sentence,
        )

    def check(self, found: Mapping[str, Any]) -> Any:
        """Publish what a check has found, the data of check.json; returns the message."""
        message = fill_checked(self._message("Checked"), lambda: self._message("Change"), found)
        self._checked.publish(message)
        return message

    def moved(self, moved: Moved) -> None:
        """Publish that images show something to have been moved."""
        self._suspect(
            place=moved.what,
            direction="all",
            driver="time",
            since_s=moved.since,
            size_mm=1e3 * moved.shift_m,
            size_deg=float(np.degrees(moved.turn_rad)),
            sentence=moved.sentence,
        )

    def _suspect(self, **change: Any) -> None:
        self._change.publish(fill_change(self._message("Change"), change))
        self.hold(False)

    def no_change(self) -> None:
        """Publish that nothing is suspected any more."""
        self._change.publish(self._message("Change"))

    def estimate(self, estimator: Estimator) -> None:
        """Publish the values as they stand, and their standard deviations."""
        if np.isfinite(estimator.values).all() and np.isfinite(estimator.std).all():
            message = self._message("Estimate")
            self._estimate.publish(fill_estimate(message, estimator.names, estimator.values, estimator.std))
