"""Real arms, whole recordings: what the README's table says. Needs ../shared/data beside the checkout.

The tests run the same on as much of it as shows the claims (tests/test_real_data.py).

Causes that are named, the same by each of five seeds (series A: every fifteenth pose, two seeds); beside each what
speaks for it that is not of its own recording:

| | named | |
| --- | --- | --- |
| series A, D: one UR10 | gears of pan, lift, elbow, wrist 2 in both; of wrist 3 in A | each in the other series |
| UR5 grid | gears of pan, lift, elbow | as above, another arm |
| WAM grid | none | |
| Panda 3, Panda 4 | against load, joint 2; 240 waves a turn of joint 4; 120 or 240 of joint 3 | both arms |
| iiwa 14 | a step of base or plate; give of joints 3, 4; of joint 2 play or a curve | nothing: not confirmed |
"""

from __future__ import annotations

import harness

# isort: split
import sys

import recorded

SERIES = {"ipa_ur10_series_a": ("--block", 200), "ipa_ur10_series_d": ("--block", 10)}
FROZEN = "series_a_frozen_on_d"  # base and tool refitted
SOCKETS = ("mukca_panda_3", "mukca_panda_4", "mukca_kuka_14")


def one(task: harness.Task) -> harness.Result:
    """Held-out RMS [mm] by stage, the status, and what the model contains."""
    name = task["recording"]
    with harness.scratch() as folder:
        if name == FROZEN:
            first, second = (recorded.imported(series, folder) for series in SERIES)
            harness.succeeded("calibrate", first, *SERIES["ipa_ur10_series_a"], "--out", folder / "first")
            verb = ("evaluate", folder / "first", second, "--refit-base", "--refit-tool")
        else:
            cell = harness.ROOT / "examples" / "import" / f"{name}_cell.yaml"
            more = SERIES.get(name, ("--tip", "ball_link", "--cell", cell, "--block", 1))
            verb = ("calibrate", recorded.imported(name, folder), *more)
        harness.succeeded(*verb, "--out", folder / "out", codes=(0, 3))
        report = harness.report_of(folder / "out")
    sizes = {stage: report["error_mm"][stage]["rms"] for stage in ("nominal", "geometric", "final")}
    effects = ", ".join(f"{e['family']} {e['place']}" for e in report["effects"])
    return {**sizes, "status": report["status"], "effects": effects}


def main() -> int:
    harness.data()
    given = harness.options(__doc__, seeds=0, names=(*SERIES, FROZEN, *SOCKETS))
    keys = ("recording", "nominal", "geometric", "final", "status", "effects")
    results = harness.each(one, harness.tasks(given, recording=given.names), given, lambda r: f"{r['final']:.3f} mm")
    harness.table("Held-out RMS, mm", keys, [[r[key] for key in keys] for r in results if not r["failed"]])
    return int(bool(harness.failures(results)))


if __name__ == "__main__":
    sys.exit(main())
