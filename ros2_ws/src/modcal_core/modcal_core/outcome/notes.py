"""Notes on a recording and a fit: sentences that stand beside the verdict."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from modcal_core.calibration import Calibration, Errors, Fit, Readmitted
from modcal_core.diagnosis import Loads
from modcal_core.geometry import error_values, se3
from modcal_core.hypotheses import LIMIT_OF_REACH
from modcal_core.measurements import Samples, spread_rows
from modcal_core.measurements.kinds import kinds
from modcal_core.outcome.entries import MAX_SEEN, Finding, at_tool, rms
from modcal_core.robots import Mechanism
from modcal_core.verdict import TOGETHER, Case, Contribution, Verdict


def counted(count: int, thing: str) -> str:
    """A number and what it counts, in the plural where it is one: ``1 station``, ``2 stations``."""
    return f"{count} {thing}" if count == 1 else f"{count} {thing}s"


def instrument_notes(fit: Fit) -> tuple[str, ...]:
    """For each kind of reading that is no position how it scatters about the model."""
    out = []
    for name, size in fit.noise.others.items():
        kind = kinds()[name]
        said = f"{1e3 * size:.3g} mm" if kind.unit == "m" else f"{1e6 * size:.3g} µrad"
        out.append(f"Readings of kind {name} scatter about the model by {said}.")
    return tuple(out)


_ALIKE = 5e-3  # m, rad: no two instruments stand so close, and turned so alike


def one_instrument_notes(fit: Fit) -> tuple[str, ...]:
    """A sentence for two frames with the same coordinates, surely: those of one instrument under two names have."""
    model, out = fit.model, []
    row = {(p.frame, p.direction): i for i, p in enumerate(fit.parameters) if p.place == 0}
    for a, b in combinations(range(len(model.frames)), 2):
        if model.leader(a) == model.leader(b):
            continue
        apart = np.abs(error_values(se3.inverse(model.T_frame_base[a]) @ model.T_frame_base[b]))
        own = [[row[model.leader(f), d] for f in (a, b) if (model.leader(f), d) in row] for d in range(6)]
        signs = np.array([1.0, -1.0])
        std = [float(np.sqrt(signs[: len(i)] @ fit.covariance[np.ix_(i, i)] @ signs[: len(i)])) for i in own]
        if (apart + 2.0 * np.array(std) < _ALIKE).all():
            out.append(
                f"Frames {model.frames[a]} and {model.frames[b]} have the same coordinates, to "
                f"{1e3 * np.linalg.norm(apart[:3]):.2g} mm: give the readings of one instrument one frame_id; now each "
                "frame has a place of its own."
            )
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


def stated_note(stated: Sequence[Finding]) -> tuple[str, ...]:
    """A sentence on the moves of base and tool that were stated, with their fitted sizes."""
    return (f"As stated, in every model: {'; '.join(move.what for move in stated)}.",) if stated else ()


def unproved_note(unproved: Sequence[Finding]) -> tuple[str, ...]:
    """A sentence on effects that predict together and that held-out stations do not prove one by one."""
    if not unproved:
        return ()
    are = "is" if len(unproved) == 1 else "are"
    names = ", ".join(dict.fromkeys(f"{finding.family} of {finding.place}" for finding in unproved))
    return (
        f"{counted(len(unproved), 'further effect')} in the model {are} not proved by stations that were not used, and "
        f"named as no cause: {names}.",
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


def not_asked_note(verdict: Verdict) -> tuple[str, ...]:
    """A sentence on what so few stations do not answer; none where everything could be asked."""
    if not verdict.not_asked:
        return ()
    questions = ", or ".join(f"{question.what} (that needs {question.needs})" for question in verdict.not_asked)
    return (f"These stations are too few to ask {questions}.",)


def residual_notes(case: Case, worth: Sequence[Contribution]) -> tuple[str, ...]:
    """A sentence on the effects of the scored model that no entry contains, largest joint first; none without them."""
    model, scored = case.model, case.scored
    part = next((part for part in worth if part.label == TOGETHER), None)
    if part is None:
        return ()
    few = scored.select(spread_rows(len(scored), MAX_SEEN))
    of_joint: dict[str, list[int]] = {}
    for i in part.numbers:
        of_joint.setdefault(model.effects[i].place, []).append(i)
    size = {joint: 1e3 * at_tool(model, own, few) for joint, own in of_joint.items()}
    shares = ", ".join(f"{joint} {size[joint]:.3f} mm" for joint in sorted(size, key=lambda j: -size[j]))
    with_them = 1e3 * rms(case.errors["final"])
    alone = float(np.sqrt(max(with_them**2 + part.mm2, 0.0)))
    return (
        f"Beside what is named, small curves of joints, each held as small as these stations make likely, were learned "
        f"together (RMS at the tool: {shares}); without them the error would be {alone:.3f} instead of {with_them:.3f} "
        "mm. None of them is claimed as a cause.",
    )


_NORMAL = 1.96  # deviations of a 95 % interval


def load_notes(loads: Loads | None) -> tuple[str, ...]:
    """Sentences on gravity and payloads, with 95 % intervals."""
    if loads is None:
        return ()
    out = []
    if loads.unknown:
        out.append(
            "The stations cannot tell gravity: joints seem to deflect under a weight that pulls another way than the "
            "robot description says, but not which way. State gravity: in the cell file."
        )
    if loads.down is not None:
        way = ", ".join(f"{x:+.3f}" for x in loads.down)
        out.append(
            f"Weight pulls along [{way}] in the base link (± {np.degrees(_NORMAL * loads.down_std):.2g}°), "
            f"{np.degrees(loads.turned):.1f}° from where the robot description says: state gravity: in the cell file, "
            "or tilt the base in the URDF."
        )
    if loads.relative and loads.payloads:
        said = ", ".join(f"{p.mass:.2f} ± {_NORMAL * p.mass_std:.2g}" for p in loads.payloads[:-1])
        out.append(
            f"The recordings were loaded differently: {said} of what the tip carries in the last one. No mass is "
            "known, so compliances are per kg of that."
        )
    elif loads.payloads:
        said = ", ".join(f"{p.mass:.2f} ± {_NORMAL * p.mass_std:.2g} kg" for p in loads.payloads)
        where = "" if len(loads.payloads) == 1 else " in the recordings, one after the other"
        out.append(f"The tip carries {said}{where} beyond what the robot description states.")
    if loads.centre is not None and loads.centre_std is not None:
        each = zip("xyz", 1e3 * loads.centre, 1e3 * _NORMAL * loads.centre_std, strict=True)
        said = ", ".join(f"{axis} {at:+.0f} ± {wide:.2g} mm" for axis, at, wide in each)
        out.append(f"The payload that the recording states has its centre at {said} in the tip link.")
    return tuple(out)
