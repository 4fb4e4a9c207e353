"""The colours of pages and pictures: each by name, on light paper and on dark."""

from __future__ import annotations

INK, SOFT, LINE, PAPER, PANEL = "ink", "soft", "line", "paper", "panel"
AFTER, BEFORE, GOOD, WARN, BAD = "after", "before", "good", "warn", "bad"

# Text stands on paper and on panels in ink, soft, after, good, warn and bad: those keep a contrast of 4.5 there.
COLOURS: dict[str, tuple[str, str]] = {
    INK: ("#1c2430", "#e6eaf0"),
    SOFT: ("#566172", "#a9b3c1"),
    LINE: ("#d5dbe4", "#3a4350"),
    PAPER: ("#ffffff", "#12161c"),
    PANEL: ("#f3f6fa", "#1c222b"),
    AFTER: ("#1a5fd0", "#7db1ff"),
    BEFORE: ("#8791a0", "#7f8a99"),
    GOOD: ("#2c6a38", "#7fcb8d"),
    WARN: ("#85560a", "#e3b560"),
    BAD: ("#b3263c", "#ff8f99"),
}
LIGHT = {name: light for name, (light, _) in COLOURS.items()}
DARK = {name: dark for name, (_, dark) in COLOURS.items()}
OF_AXES = (BAD, GOOD, AFTER)  # x, y, z
TINT = 50  # per cent of `after` in the fullest cell of a map; ink can be read on it
