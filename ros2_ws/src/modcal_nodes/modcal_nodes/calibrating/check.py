"""``~/check``: what has changed since the trusted model was made, by the newest stations, beside the callbacks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.task import Future

from modcal_core.calibration import Calibration
from modcal_core.errors import NotEnoughData
from modcal_core.files import to_json
from modcal_core.measurements import Samples
from modcal_core.public import check
from modcal_core.recalibrate import SampleMemory
from modcal_core.report import checkup_data
from modcal_core.robots import Mechanism
from modcal_nodes.calibrating.worker import SolveWorker


@dataclass(frozen=True)
class LiveCheck:
    """sentence: for a person. data: text of check.json. changed: whether anything is named or left unexplained."""

    sentence: str
    data: str
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
    return LiveCheck(said, to_json(checkup_data(found)), found.status != "unchanged")


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
    """Checks of the trusted model. publish: takes the text of check.json."""

    def __init__(self, node: Node, worker: SolveWorker, publish: Callable[[str], None]) -> None:
        self._node, self._worker, self._publish = node, worker, publish
        self._waiting: Future | None = None

    @property
    def busy(self) -> str:
        """What the worker is doing; empty: nothing."""
        return self._worker.doing or (_CHECK if self._waiting is not None else "")

    async def answered(self, *work: Any) -> tuple[bool, str]:
        """Whether the check was done, and its sentence. work: the arguments of :func:`live_check`."""
        self._waiting = Future(executor=self._node.executor)
        self._worker.give(_CHECK, live_check, *work, finish=self._found, fail=partial(self._answer, False))
        success, message = await self._waiting
        return success, message

    def _found(self, check: LiveCheck) -> None:
        self._publish(check.data)
        log = self._node.get_logger()
        said = f"check: {check.sentence}"
        if check.changed:  # a place that logs keeps its severity
            log.warning(said)
        else:
            log.info(said)
        self._answer(True, check.sentence)

    def _answer(self, success: bool, message: str) -> None:
        if self._waiting is not None:
            waiting, self._waiting = self._waiting, None
            waiting.set_result((success, message))
