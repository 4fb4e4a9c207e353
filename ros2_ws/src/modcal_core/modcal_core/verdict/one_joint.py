"""One joint that scatters by far more than the others do: a loose encoder, coupling or brake.

Its error goes with nothing, so no regressor predicts it, and returns take it for what the arm does not repeat. But it
lies along the motion of that joint, and joints of one arm are much alike. The scatter of each is estimated by the
method of moments (variance components; Henderson 1953): the outer product r rᵀ of a station's residual is on average
the sum of v vᵀ times a variance, over the joints' motions v and over what an instrument and a loose target scatter
along.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modcal_core.calibration import RowView, nonnegative
from modcal_core.effects import place_index
from modcal_core.geometry import Array
from modcal_core.measurements import spread_rows
from modcal_core.measurements.kinds import is_direct
from modcal_core.robots import Chain, is_serial_arm
from modcal_core.verdict.case import Case, weights

_MAX = 300  # samples, for time; more are thinned evenly
_MIN = 30  # samples; a variance is known to a quarter by these
_MIN_JOINTS = 3  # of one kind, that a joint is compared with
_MOSTLY = 0.5  # share of the squares: most of what is left
LARGELY = 0.3  # the same beside what is predictable, where the verdict is open by that already
_TIMES = 3.0  # the scatter of the usual joint; sizes of gears and encoders in one arm differ by about two
_TOLD = 0.1  # of its scatter: the least bound that is stated for the others, where draws say none
_FAINT = 0.1  # of the squares that the same scatter of the named joint makes: what a joint makes that hardly shows
_DRAWS = 200  # of stations; the lowest hundredth is two of them
_FARTHEST = 5.0  # times the median size; no sample may rule alone
# six axes through the corners of an icosahedron, whose outer products span all covariances of three components
_AXES = np.array([[0, 1, 1.618034], [0, 1, -1.618034], [1, 1.618034, 0], [1, -1.618034, 0], [1.618034, 0, 1],
                  [-1.618034, 0, 1]]) / 1.902113  # fmt: skip


@dataclass(frozen=True)
class OneJoint:
    """names: of the joint, or of two. scatter: RMS of the lesser of them, and others: what that of each other joint is
    surely below [rad or m]. turns: whether it is revolute. share: of the squared error that they make. unseen: others
    that move the target too little to say.
    """

    names: tuple[str, ...]
    scatter: float
    others: float
    turns: bool
    share: float
    unseen: tuple[str, ...] = ()

    @property
    def sentence(self) -> str:
        """The finding as a sentence."""
        unit = "mrad" if self.turns else "mm"
        one = len(self.names) == 1
        who = f"Joint {self.names[0]} scatters by" if one else f"Joints {' and '.join(self.names)} scatter by at least"
        unseen = f" (of {' and '.join(self.unseen)} these readings say too little)" if self.unseen else ""
        see = (
            "See its encoder, coupling and brake, and whether it stands"
            if one
            else ("See their encoder, coupling and brake, and whether they stand")
        )
        return (
            f"{who} {1e3 * self.scatter:.2g} {unit} RMS and each of the others by less than "
            f"{1e3 * self.others:.2g} {unit}{unseen} ({self.share:.0%} of the squared error). {see} still when "
            "readings are taken; if the arm is like that, state its repeatability."
        )


def one_joint(case: Case, least: float = _MOSTLY) -> OneJoint | None:
    """The joint, or the two, that a share of what a case leaves is the scatter of, None where there is none."""
    rows = np.flatnonzero(~case.wrong) if case.fitted else case.held_out
    rows = rows[~case.samples.moving[rows]]
    rows = rows[spread_rows(len(rows), _MAX)]
    chain = case.model.chain
    if len(rows) < _MIN or not is_serial_arm(chain) or not is_direct(case.samples.kinds):
        return None
    residual, motions, more = _parts(case, chain, rows)
    whole = max(float(np.sum(residual**2)), 1e-300)
    along = np.sum(motions * residual, axis=1) ** 2 / np.maximum(np.sum(motions**2, axis=1), 1e-300)
    if along.sum(axis=1).max() < 0.5 * least * whole:  # no more than that can be any joint's; two may share it
        return None
    directions = np.concatenate([motions, more])
    products = np.einsum("jcn,kcn->njk", directions, directions) ** 2
    seen = np.einsum("jcn,cn->nj", directions, residual) ** 2
    variance = _variances(products.sum(axis=0), seen.sum(axis=0))[: chain.n]
    power = np.sum(motions**2, axis=(1, 2)) / whole
    share = variance * power
    first, second = (int(j) for j in np.argsort(-share)[:2])
    rng = np.random.default_rng(0)
    drawn: Array | None = None
    for loose in ([first], [first, second]):
        alike = [k for k in range(chain.n) if k not in loose and chain.revolute[k] == chain.revolute[first]]
        if share[loose].sum() < least or len(alike) < _MIN_JOINTS:
            continue
        if chain.revolute[second] != chain.revolute[first] and len(loose) > 1:
            continue
        if variance[loose].min() < _TIMES**2 * float(np.median(variance[alike])):
            continue
        if drawn is None:
            drawn = _drawn(products, seen, rng)
        at = _apart(drawn[:, : chain.n], power, loose, alike)
        if at is None:
            continue
        others, hidden = at
        size = float(variance[loose].min())
        sizes = np.sqrt([size, max(others, _TOLD**2 * size)])
        names, unseen = (tuple(chain.names[k] for k in sorted(some)) for some in (loose, hidden))
        turns = bool(chain.revolute[first])
        return OneJoint(names, float(sizes[0]), float(sizes[1]), turns, float(share[loose].sum()), unseen)
    return None


def _drawn(products: Array, seen: Array, rng: np.random.Generator) -> Array:
    """Variances of directions (draws, J) as other draws of the stations would have them.

    products, seen: of each station its squared products of directions with each other (N, J, J), and with the residual
    (N, J).
    """
    N, J = seen.shape
    some = rng.integers(N, size=(_DRAWS, N)) + N * np.arange(_DRAWS)[:, None]
    times = np.bincount(some.ravel(), minlength=_DRAWS * N).reshape(_DRAWS, N).astype(float)
    whole, met = (times @ products.reshape(N, J * J)).reshape(_DRAWS, J, J), times @ seen
    return _variances(whole, met)


def _apart(drawn: Array, power: Array, loose: list[int], alike: list[int]) -> tuple[float, list[int]] | None:
    """What the variances of joints alike are surely below, and those of them that hardly show, where some scatter by
    more than the others in nearly all draws (K, n) of stations; None where they do not.

    power: what of the squares a variance of each makes, (n,).
    """
    high = np.percentile(drawn, 97.5, axis=0)
    least = float(np.percentile(drawn[:, loose], 1.0, axis=0).min())
    above = [k for k in alike if high[k] >= least]
    seen = [k for k in alike if k not in above]
    if len(seen) < _MIN_JOINTS or any(power[k] >= _FAINT * power[loose].min() for k in above):
        return None
    return float(high[seen].max()), above


def _parts(case: Case, chain: Chain, rows: np.ndarray) -> tuple[Array, Array, Array]:
    """The residual (6, N), the motions of the joints (n, 6, N) and other directions of scatter (k, 6, N), whitened."""
    samples = case.samples.select(rows)
    view = RowView.of(case.model, samples, case.model.drivers(samples))
    weight = weights(case.noise, samples)
    N = len(samples)

    def spread_out(row: Array) -> Array:
        out = np.zeros((6, N))
        out[:3], out[3:, view.pose] = row[: 3 * N].reshape(3, N), row[3 * N :].reshape(3, -1)
        return out * weight

    residual = np.zeros((6, N))
    residual[:3], residual[3:, view.pose] = view.position, view.rotation
    residual *= weight
    size = np.linalg.norm(residual, axis=0)
    residual *= np.minimum(1.0, _FARTHEST * float(np.median(size)) / np.maximum(size, 1e-300))
    axes = [
        (place_index(name, chain), 5 if turns else 2) for name, turns in zip(chain.names, chain.revolute, strict=True)
    ]
    motions = np.stack([spread_out(view.unit_column(*where)) for where in axes])
    target = [spread_out(view.unit_column(chain.tool_place, d)) for d in range(3)]
    sight = view.expected
    sight = sight / max(float(np.abs(sight).max()), 1e-9)
    instrument = []
    for part in (slice(0, 3), slice(3, 6)):
        for axis in _AXES:
            along = np.zeros((6, N))
            along[part] = axis[:, None]
            instrument.append(along * weight)
    for errs in (sight, *(np.cross(sight.T, axis).T for axis in np.eye(3))):  # of a distance, of angles
        out = np.zeros((6, N))
        out[:3] = errs
        instrument.append(out * weight)
    return residual, motions, np.stack([*target, *instrument])


def _variances(products: Array, seen: Array) -> Array:
    """Variances (..., J) that are not negative, by least squares over all elements of the outer products."""
    size = np.sqrt(np.maximum(np.einsum("...jj->...j", products), 1e-300))
    G = products / (size[..., :, None] * size[..., None, :])
    return nonnegative(G + 1e-9 * np.eye(G.shape[-1]), seen / size) / size
