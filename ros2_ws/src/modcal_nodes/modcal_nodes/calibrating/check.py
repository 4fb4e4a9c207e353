"""``~/check``: what has changed since the trusted model was made, by the newest stations, beside the callbacks."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from rclpy.callback_groups import ReentrantCallbackGroup
from std_srvs.srv import Trigger

from modcal_core.calibration import Calibration
from modcal_core.errors import NotEnoughData
from modcal_core.measurements import Samples
from modcal_core.public import check
from modcal_core.recalibrate import SampleMemory
from modcal_core.report import checkup_data
from modcal_core.robots import Mechanism
from modcal_nodes.calibrating.publishers import Publishers
from modcal_nodes.calibrating.worker import SolveWorker
from modcal_nodes.ros import DONE, FAILED, Action, GuardedNode


@dataclass(frozen=True)
class LiveCheck:
    """sentence: for a person. data: of check.json. changed: whether anything is named or left unexplained."""

    sentence: str
    data: dict[str, Any]
    changed: bool


def live_check(
    heard: SampleMemory,
    chain: Mechanism,
    calibration: Calibration,
    clock_limit: float,
    newest: int,
    since: float | None,
) -> LiveCheck:
    """The check by the newest stations; of those since a stamp [s] where something is suspected to have changed.

    Raises ModcalError for too few, or for what is not of this arm.
    """
    samples, _, _ = heard.prepared(chain, clock_limit)
    found = check(calibration, newest_of(samples, newest, since))
    said = f"{found.sentence} {found.advice.sentence}"
    return LiveCheck(said, checkup_data(found), found.status != "unchanged")


def newest_of(samples: Samples, count: int, since: float | None) -> Samples:
    """The samples of the newest stations, of those since a stamp where one is given. Raises NotEnoughData."""
    first = -np.inf if since is None else since
    stations = samples.station[samples.stamps >= first]
    kept = np.unique(stations)[-count:]
    if len(kept) < count:
        where = "" if since is None else " since something seems to have changed"
        raise NotEnoughData(
            f"{len(kept)} stations{where}", f"a check looks at {count}", "drive to more, or set check_stations"
        )
    return samples.select(np.flatnonzero(np.isin(samples.station, kept)))


_CHECK = "check"


class CheckService:
    """Checks of the trusted model, as the action and the Trigger ~/check."""

    def __init__(self, node: GuardedNode, worker: SolveWorker, outputs: Publishers, begin: Callable[[], str]) -> None:
        """begin: calls :meth:`begin` with what is to be checked; returns why it cannot, or nothing."""
        self._node, self._worker, self._outputs, self._begun = node, worker, outputs, 0.0
        self._action = Action(node, "Check", begin, self.cancel, self._progress)
        self._ask = begin
        node.create_service(Trigger, "~/check", self._on_check, callback_group=ReentrantCallbackGroup())

    async def _on_check(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Say what has changed since the trusted model was made, by the newest stations; answer when known."""
        if refusal := self._ask():
            response.success, response.message = False, refusal
            return response
        result = await self._action.ended()
        response.success, response.message = result.outcome == DONE, result.message
        return response

    def begin(self, *work: Any) -> str:
        """Have it done; returns why not, or nothing. work: the arguments of :func:`live_check`."""
        if self._worker.doing:
            return f"busy with {self._worker.doing}: ask again"
        self._begun = time.monotonic()
        self._worker.give(_CHECK, live_check, *work, finish=self._found, fail=partial(self._action.end, FAILED))
        return ""

    def cancel(self, why: str = "cancelled") -> None:
        """End the check that is being made, if one is."""
        if self._worker.doing == _CHECK:
            self._worker.drop()
            self._action.end(FAILED, why)

    def _progress(self, feedback: Any) -> None:
        feedback.phase, feedback.elapsed_s = "checking", time.monotonic() - self._begun

    def _found(self, check: LiveCheck) -> None:
        message = self._outputs.check(check.data)
        log = self._node.get_logger()
        said = f"check: {check.sentence}"
        if check.changed:  # a place that logs keeps its severity
            log.warning(said)
        else:
            log.info(said)
        self._action.end(DONE, f"{check.sentence} {self._outputs.about()}", checked=message)
