"""Is "certain" right, on real tracks otherwise and of things that are no one joint?

    python bench/articulated/run.py                             # real tracks in ten variants, and what is no joint
    python bench/articulated/run.py --only beyond --kinds design

Real tracks are read from ../shared/data/articulation beside the checkout, and left out where that is absent.
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse  # noqa: E402
import sys  # noqa: E402
import zlib  # noqa: E402
from pathlib import Path  # noqa: E402

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(1, str(ROOT / "tests"))
import beyond  # noqa: E402
import numpy as np  # noqa: E402
from articulation.furniture_tracks import recorded  # noqa: E402
from variants import VARIANTS  # noqa: E402

from modcal_core.articulation.choice import choose  # noqa: E402
from modcal_core.articulation.online import Tracker  # noqa: E402
from modcal_core.articulation.track import Track  # noqa: E402

DATA = ROOT.parent / "shared" / "data" / "articulation"
PERIOD = 0.05  # s


def trusted_share(track: Track) -> float:
    """Share of poses after which the tracker trusted its model."""
    tracker = Tracker()
    states = [
        tracker.update(p, None if track.rotations is None else track.rotations[i], PERIOD * i).trusted
        for i, p in enumerate(track.positions)
    ]
    return float(np.mean(states))


def real(some: int, online: bool, names: list[str], log: bool) -> None:
    """A row for every variant."""
    tracks = list(recorded(DATA).items())[::some]
    print(f"{'variant':16} tracks  right  certain  certain and wrong" + ("  trusted share" if online else ""))
    for name, vary in VARIANTS.items():
        if names and name not in names:
            continue
        right, sure, wrong, shares = 0, 0, [], []
        for title, (truth, whole) in tracks:
            rng = np.random.default_rng(zlib.crc32(f"{name} {title}".encode()))
            track = vary(whole, rng)
            if len(track) < 8:
                continue
            choice = choose(track)
            right += choice.kind == truth
            sure += choice.enough
            if choice.enough and choice.kind != truth:
                wrong.append(f"{title}: {choice.why}")
            if log:
                print(f"   {name} {title} {truth}: {choice.enough} {choice.why}", flush=True)
            if online:
                shares.append(trusted_share(track))
        share = f"  {np.mean(shares):13.2f}" if online else ""
        print(f"{name:16} {len(tracks):6} {right:6} {sure:8} {len(wrong):18}{share}", flush=True)
        for line in wrong:
            print(f"   ✗ {line}", flush=True)


def no_joint(kinds: list[str], seeds: int, online: bool, log: bool) -> None:
    """A row for every kind that is no joint."""
    print(f"{'kind':24} tracks  certain" + ("  trusted share" if online else ""))
    every, said = 0, 0
    for kind in kinds:
        sure, shares = 0, []
        for seed in range(seeds):
            seen = beyond.seen(kind, seed)
            track = Track(seen.positions, seen.rotations)
            choice = choose(track)
            certain = choice.enough and choice.kind != "none"
            sure += certain
            if log or certain:
                print(f"   {kind} {seed}: {choice.enough} {choice.why}", flush=True)
            if online:
                shares.append(trusted_share(track))
        every, said = every + seeds, said + sure
        share = f"  {np.mean(shares):13.2f}" if online else ""
        print(f"{kind:24} {seeds:6} {sure:8}{share}", flush=True)
    print(f"{'all':24} {every:6} {said:8}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=("real", "beyond"), default=None)
    parser.add_argument("--kinds", choices=("design", "kept", "later", "all"), default="all")
    parser.add_argument("--variants", default="", help="comma-separated; default: all")
    parser.add_argument("--every", type=int, default=1, help="Of real tracks, every so many.")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--online", action="store_true", help="Also how long the tracker trusts its model.")
    parser.add_argument("--log", action="store_true", help="A line for every track.")
    chosen = parser.parse_args()
    if chosen.only != "real":
        every = {**beyond.DESIGN, **beyond.KEPT, **beyond.LATER}
        sets = {"design": beyond.DESIGN, "kept": beyond.KEPT, "later": beyond.LATER, "all": every}
        no_joint(list(sets[chosen.kinds]), chosen.seeds, chosen.online, chosen.log)
    if chosen.only != "beyond" and DATA.is_dir():
        real(chosen.every, chosen.online, [v for v in chosen.variants.split(",") if v], chosen.log)
    return 0


if __name__ == "__main__":
    sys.exit(main())
