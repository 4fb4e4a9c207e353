"""What the calibrator publishes: the trusted model, what was found, and the running estimate."""

from __future__ import annotations

import json
from collections.abc import Mapping

import numpy as np
from rclpy.node import Node
from std_msgs.msg import Bool, Float64, Float64MultiArray, MultiArrayDimension, String

from modcal_core.camera import Moved
from modcal_core.online import ChangeHypothesis, Estimator
from modcal_core.recalibrate import ModelComparison
from modcal_nodes.ros import LATCHED

_OF_THE_MODEL = {
    "~/robot_description": "calibrated.urdf",
    "~/calibration": "calibration.yaml",
    "~/report": "report.json",
}


class Publishers:
    """The calibrator's publishers. All are latched but the running estimate."""

    def __init__(self, node: Node) -> None:
        self._texts = {
            topic: node.create_publisher(String, topic, LATCHED) for topic in (*_OF_THE_MODEL, "~/change", "~/checked")
        }
        self._names = node.create_publisher(String, "~/estimate_names", LATCHED)
        self._estimate = node.create_publisher(Float64MultiArray, "~/estimate", 10)
        self._residual = node.create_publisher(Float64, "~/residual", LATCHED)
        self._before = node.create_publisher(Float64, "~/residual_before", LATCHED)
        self._trusted = node.create_publisher(Bool, "~/trusted", LATCHED)
        self._last_names: tuple[str, ...] = ()
        self._trusted.publish(Bool(data=False))  # until there is a model: who asks is not left waiting

    def model(self, files: Mapping[str, str]) -> None:
        """Publish a model that is trusted from now on."""
        for topic, name in _OF_THE_MODEL.items():
            if name in files:
                self._texts[topic].publish(String(data=files[name]))
        self._trusted.publish(Bool(data=True))

    def result(self, rms: float | None, comparison: ModelComparison) -> None:
        """Publish how large the error is on stations that the fit has not seen, and was before [m]."""
        if rms is not None and np.isfinite(rms):
            self._residual.publish(Float64(data=float(rms)))
        if np.isfinite(comparison.before):
            self._before.publish(Float64(data=float(comparison.before)))

    def change(self, hypothesis: ChangeHypothesis) -> None:
        """Publish that something has changed, and what it may be; the model is not to be trusted blindly."""
        data = {
            "place": hypothesis.place,
            "direction": hypothesis.direction,
            "driver": hypothesis.driver,
            "since_s": hypothesis.since,
            "size_mm": 1e3 * hypothesis.size,
            "same_as": list(hypothesis.same_as),
            "sentence": hypothesis.sentence,
        }
        self._suspect(data)

    def check(self, data: str) -> None:
        """Publish what a check has found: the text of check.json."""
        self._texts["~/checked"].publish(String(data=data))

    def moved(self, moved: Moved) -> None:
        """Publish that images show something to have been moved."""
        data = {
            "place": moved.what,
            "direction": "all",
            "driver": "time",
            "since_s": moved.since,
            "size_mm": 1e3 * moved.shift_m,
            "size_deg": float(np.degrees(moved.turn_rad)),
            "same_as": [],
            "sentence": moved.sentence,
        }
        self._suspect(data)

    def _suspect(self, change: dict[str, object]) -> None:
        self._texts["~/change"].publish(String(data=json.dumps(change, allow_nan=False)))
        self._trusted.publish(Bool(data=False))

    def no_change(self) -> None:
        """Publish that nothing is suspected any more."""
        self._texts["~/change"].publish(String(data="{}"))

    def estimate(self, estimator: Estimator) -> None:
        """Publish the values as they stand, and their standard deviations."""
        values = np.stack([estimator.values, estimator.std])
        if not np.isfinite(values).all():
            return
        if estimator.names != self._last_names:
            self._last_names = estimator.names
            self._names.publish(String(data="\n".join(estimator.names)))
        message = Float64MultiArray(data=[float(v) for v in values.ravel()])
        message.layout.dim = [
            MultiArrayDimension(label="value, standard deviation", size=2, stride=values.size),
            MultiArrayDimension(label="parameter", size=values.shape[1], stride=values.shape[1]),
        ]
        self._estimate.publish(message)
