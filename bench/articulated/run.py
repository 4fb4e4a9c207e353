"""Is "certain" right, on real tracks otherwise and of things that are no one joint?

    python bench/articulated/run.py                             # real tracks in ten variants, and what is no joint
    python bench/articulated/run.py --only beyond --kinds design
    python bench/articulated/run.py --only beyond --online      # and how the tracker trusts while they move
    python bench/articulated/run.py --online --trust-after 0.4  # the same, if trust waits for so many metres of path

Online there are three shares: of poses at which a model was trusted, of poses at which it was although the path leaves
it by more than twice the tolerance within the distance ahead, and of tracks at whose end it was; then the tracks that
were trusted at any time, and the median of the path that they had come by then.

Real tracks are read from ../shared/data/articulation beside the checkout, and left out where that is absent.
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse  # noqa: E402
import sys  # noqa: E402
import zlib  # noqa: E402
from dataclasses import dataclass  # noqa: E402
from pathlib import Path  # noqa: E402

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(1, str(ROOT / "tests"))
import beyond  # noqa: E402
import numpy as np  # noqa: E402
from articulation.furniture_tracks import recorded  # noqa: E402
from variants import VARIANTS  # noqa: E402

from modcal_core.articulation.choice import choose  # noqa: E402
from modcal_core.articulation.online import Tracker, TrackerSettings  # noqa: E402
from modcal_core.articulation.telling import travelled  # noqa: E402
from modcal_core.articulation.track import Track  # noqa: E402

DATA = ROOT.parent / "shared" / "data" / "articulation"
PERIOD = 0.05  # s
ONLINE = "  trusted  and wrong  at end  ever  after"


@dataclass(frozen=True)
class Trust:
    """Of one track: share of poses at which a model was trusted, and at which it was and failed; whether at the end.

    after: path [m] at which it was trusted first, nan where it never was.
    """

    trusted: float
    wrong: float
    at_end: bool
    after: float

    @staticmethod
    def said(some: list[Trust]) -> str:
        """Means of some, for a row."""
        columns = ([t.trusted for t in some], [t.wrong for t in some], [float(t.at_end) for t in some])
        first = [t.after for t in some if not np.isnan(t.after)]
        after = f"  {len(first):4}  {1e2 * np.median(first):3.0f} cm" if first else "     0"
        return "".join(f"  {100.0 * np.mean(column):7.1f} %" for column in columns) + after


def trust(track: Track, after: float) -> Trust:
    """As the tracker follows it, with trust after so much path [m]."""
    settings = TrackerSettings(trust_after_m=after)
    tracker, first = Tracker(settings), float("nan")
    n = len(track)
    way = travelled(track)
    smooth = np.array([np.median(track.positions[max(0, i - 2) : i + 3], axis=0) for i in range(n)])
    sure, wrong = np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
    for i, p in enumerate(track.positions):
        state = tracker.update(p, None if track.rotations is None else track.rotations[i], PERIOD * i)
        sure[i] = state.trusted
        if state.trusted and np.isnan(first):
            first = state.path_m
        if not state.trusted or state.model is None:
            continue
        ahead = settings.ahead_m
        if state.model.turns:
            ahead = min(ahead, settings.ahead_rad * state.model.length_per_unit)
        coming = smooth[(way > way[i]) & (way <= way[i] + ahead)]
        if len(coming):
            off = np.linalg.norm(state.model.position(state.model.configuration(coming)) - coming, axis=1)
            wrong[i] = off.max() > 2.0 * settings.tolerance_m
    return Trust(float(sure.mean()), float(wrong.mean()), bool(sure[-1]), first)


def real(some: int, online: bool, names: list[str], log: bool, after: float, offline: bool) -> None:
    """A row for every variant."""
    tracks = list(recorded(DATA).items())[::some]
    print(f"{'variant':16} tracks  right  certain  certain and wrong" + (ONLINE if online else ""))
    for name, vary in VARIANTS.items():
        if names and name not in names:
            continue
        right, sure, wrong, shares = 0, 0, [], []
        for title, (truth, whole) in tracks:
            rng = np.random.default_rng(zlib.crc32(f"{name} {title}".encode()))
            track = vary(whole, rng)
            if len(track) < 8:
                continue
            if offline:
                choice = choose(track)
                right += choice.kind == truth
                sure += choice.enough
                if choice.enough and choice.kind != truth:
                    wrong.append(f"{title}: {choice.why}")
                if log:
                    print(f"   {name} {title} {truth}: {choice.enough} {choice.why}", flush=True)
            if online:
                shares.append(trust(track, after))
        share = Trust.said(shares) if online else ""
        print(f"{name:16} {len(tracks):6} {right:6} {sure:8} {len(wrong):18}{share}", flush=True)
        for line in wrong:
            print(f"   ✗ {line}", flush=True)


def no_joint(kinds: list[str], seeds: int, online: bool, log: bool, after: float, offline: bool) -> None:
    """A row for every kind that is no joint."""
    print(f"{'kind':24} tracks  certain" + (ONLINE if online else ""))
    every, said, all_shares = 0, 0, []
    for kind in kinds:
        sure, shares = 0, []
        for seed in range(seeds):
            seen = beyond.seen(kind, seed)
            track = Track(seen.positions, seen.rotations)
            if offline:
                choice = choose(track)
                certain = choice.enough and choice.kind != "none"
                sure += certain
                if log or certain:
                    print(f"   {kind} {seed}: {choice.enough} {choice.why}", flush=True)
            if online:
                shares.append(trust(track, after))
        every, said, all_shares = every + seeds, said + sure, all_shares + shares
        share = Trust.said(shares) if online else ""
        print(f"{kind:24} {seeds:6} {sure:8}{share}", flush=True)
    print(f"{'all':24} {every:6} {said:8}{Trust.said(all_shares) if online else ''}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=("real", "beyond"), default=None)
    parser.add_argument(
        "--kinds",
        choices=("design", "kept", "later", "last", "shaping", "fresh", "unseen", "aside", "all"),
        default="all",
    )
    parser.add_argument("--variants", default="", help="comma-separated; default: all")
    parser.add_argument("--every", type=int, default=1, help="Of real tracks, every so many.")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--online", action="store_true", help="Also how long the tracker trusts its model.")
    parser.add_argument("--trust-after", type=float, default=0.0, help="Path [m] before the tracker trusts.")
    parser.add_argument("--not-offline", action="store_true", help="Only how the tracker trusts.")
    parser.add_argument("--log", action="store_true", help="A line for every track.")
    chosen = parser.parse_args()
    online, offline = chosen.online or chosen.not_offline, not chosen.not_offline
    if chosen.only != "real":
        sets = {"design": beyond.DESIGN, "kept": beyond.KEPT, "later": beyond.LATER, "last": beyond.LAST}
        sets |= {"shaping": beyond.SHAPING, "fresh": beyond.FRESH, "unseen": beyond.UNSEEN, "aside": beyond.ASIDE}
        sets["all"] = {kind: maker for some in sets.values() for kind, maker in some.items()}
        no_joint(list(sets[chosen.kinds]), chosen.seeds, online, chosen.log, chosen.trust_after, offline)
    if chosen.only != "beyond" and DATA.is_dir():
        names = [v for v in chosen.variants.split(",") if v]
        real(chosen.every, online, names, chosen.log, chosen.trust_after, offline)
    return 0


if __name__ == "__main__":
    sys.exit(main())
