"""A picture in docs/results.md: how far the tool misses before and after, for the recording in bags/.

.venv/bin/python scripts/picture.py      # writes docs/held_out.svg; after `make build`
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))
import conftest  # noqa: E402, F401 (finds the install tree)
import matplotlib  # noqa: E402
import numpy as np  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402

from modcal_core.report.report import Report  # noqa: E402
from modcal_nodes.io.inputs import calibrate_bag  # noqa: E402
from modcal_nodes.io.options import Options  # noqa: E402

STAGES = (
    ("nominal", "nominal", "#b3261e"),
    ("geometric", "geometry corrected", "#a15c00"),
    ("final", "with unmodelled effects", "#1a5fb4"),
)


def picture(report: Report) -> Figure:
    """Share of held-out stations at which the tool misses by no more than so much, for each model."""
    figure = Figure(figsize=(8.0, 3.2), facecolor="white", layout="constrained")
    axes = figure.subplots()
    for stage, title, colour in STAGES:
        miss = np.sort(1e3 * report.errors[stage].position_norm)
        share = 100.0 * np.arange(1, len(miss) + 1) / len(miss)
        size = report.size_mm(stage)
        assert size is not None
        axes.step(miss, share, where="post", color=colour, lw=2.2)
        axes.annotate(
            f"{title}\n{size.rms:.2g} mm RMS", (np.median(miss), 108.0), color=colour, ha="center", fontsize=10,
            annotation_clip=False,
        )  # fmt: skip
    axes.set_xscale("log")
    axes.set_ylim(0.0, 130.0)
    axes.set_yticks([0, 25, 50, 75, 100], ["0", "25", "50", "75", "100 %"])
    axes.xaxis.set_major_formatter("{x:g}")
    axes.set_xlabel("the tool is off by no more than … mm")
    axes.set_ylabel("of the stations held out")
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.25)
    return figure


def main() -> None:
    """Calibrate and draw."""
    done = calibrate_bag(ROOT / "bags" / "ur10_cell", Options())
    with matplotlib.rc_context({"svg.hashsalt": "modcal", "svg.fonttype": "none"}):
        picture(done.result.report).savefig(ROOT / "docs" / "held_out.svg", metadata={"Date": None})


if __name__ == "__main__":
    main()
