"""Sentences beside a report: what readings do not see, and where a calibration is used that it was not made for."""

from __future__ import annotations

from modcal_core.calibration.identify import Fit
from modcal_core.calibration.readmitted import Readmitted
from modcal_core.calibration.score import Errors
from modcal_core.calibration.store import Calibration
from modcal_core.measurements.kinds.registry import kinds
from modcal_core.measurements.marks import share_of_known
from modcal_core.measurements.samples import Samples
from modcal_core.plausibility.require import LIMIT_OF_REACH
from modcal_core.report.counted import counted
from modcal_core.robots.mechanism import Mechanism

_OWN = 0.05  # share of samples; the same posture and reading to the last digit may come again where digits are few


def instrument_notes(fit: Fit) -> tuple[str, ...]:
    """For each kind of reading that is no position what it cannot see, and how it scatters about the model."""
    out = []
    for name, size in fit.noise.others.items():
        kind = kinds()[name]
        said = f"{1e3 * size:.3g} mm" if kind.unit == "m" else f"{1e6 * size:.3g} µrad"
        out.append(f"Readings of kind {name} scatter about the model by {said}. {kind.blind}")
    return tuple(out)


def description_note(nominal: Errors, chain: Mechanism) -> tuple[str, ...]:
    """A sentence where the nominal model misses by more than a robot of that description should.

    nominal: what it leaves with base and tool fitted.
    """
    size, limit = nominal.size_mm(), 1e3 * LIMIT_OF_REACH * chain.reach()
    if size is None or size.rms <= limit:
        return ()
    return (
        f"The nominal model misses by {size.rms:.0f} mm RMS, though a robot of that description should by less than "
        f"{limit:.0f} mm. The fitted geometry makes up for it where stations are; see whether the description is that "
        "of this robot, and whether a joint's zero has changed, before it is used elsewhere.",
    )


def readmitted_note(again: Readmitted) -> tuple[str, ...]:
    """A sentence for stations that were rejected first and fitted after all, where they are, and what would tell."""
    if not again.stations:
        return ()
    where = [f"{p.joint} between {p.low:.2f} and {p.high:.2f} ({p.stations} of {p.of} there)" for p in again.places]
    shown = f" They show the curve of {' and of '.join(where)}." if where else ""
    still = f" {again.unscored} of them are left out of the score still." if again.unscored else ""
    return (
        f"{counted(again.stations, 'station')} that the model first missed were taken in again, since no others "
        f"contradict them.{shown}{still} If they are wrong readings, the curve is wrong there; stations there on "
        "another day would tell.",
    )


def moved_note(residuals: Errors, calibration: Calibration, refit_base: bool, refit_tool: bool) -> tuple[str, ...]:
    """A sentence for the person whose robot, tracker or tool stands elsewhere than when it was calibrated."""
    size = residuals.size_mm()
    limit = LIMIT_OF_REACH * calibration.nominal.chain.reach()
    if size is None or size.rms < 1e3 * limit or (refit_base and refit_tool):
        return ()
    return (
        "The error is larger than an arm's: base or tool have changed; --refit-base and --refit-tool fit them again.",
    )


def own_note(samples: Samples, calibration: Calibration) -> tuple[str, ...]:
    """A sentence where samples are those that the calibration was fitted to, which make any fit look good."""
    share = share_of_known(calibration.marks, samples)
    if share <= _OWN:
        return ()
    many = "All" if share == 1.0 else f"About {share:.0%}"
    return (
        f"{many} of these samples are of the calibration's own recording, with the same joints and readings to the "
        "micrometre. It was fitted to them: their error is smaller than that of others, and shows no change. Evaluate "
        "another recording, or use the error that calibrate held out.",
    )


def unseen_note(samples: Samples, calibration: Calibration, beyond: float = 0.0) -> tuple[str, ...]:
    """A sentence for joints that go where the calibration has never seen them, and what is done there.

    beyond: share of the samples that may do so without a word.
    """
    low, high = calibration.seen
    margin = 0.02 * (high - low)
    out = (samples.q < low - margin) | (samples.q > high + margin)
    if out.any(axis=1).mean() <= beyond:
        return ()
    worst = [
        f"{name} (seen {low[j]:.2f} … {high[j]:.2f}, here {samples.q[:, j].min():.2f} … {samples.q[:, j].max():.2f})"
        for j, name in enumerate(samples.names)
        if out[:, j].any()
    ]
    return (
        f"{int(out.any(axis=1).sum())} of {len(samples)} samples lie outside the joint ranges that were calibrated: "
        f"{', '.join(worst)}. {_spoken(samples, calibration)}",
    )


def _spoken(samples: Samples, calibration: Calibration) -> str:
    """Note about what the model does outside the calibrated ranges."""
    instead = calibration.fallback(calibration.calibrated, calibration.geometric)
    count = 0 if instead is None else int((instead.share(samples) > 0.0).sum())
    if not count:
        return "Learned curves are not continued there."
    return (
        f"Learned curves are not continued there: at {count} samples, where the full model is not known to be better, "
        "the geometry that is best alone counts instead."
    )
