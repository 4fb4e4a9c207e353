"""The image with what was found in it, for a person to look at."""

from __future__ import annotations

import cv2
import numpy as np

from modcal_core.camera.views import BoardView

_GOOD, _BAD, _PAPER = (60, 180, 60), (60, 60, 220), (255, 255, 255)


def annotated(grey: np.ndarray, view: BoardView | None, said: str) -> np.ndarray:
    """A colour image (h, w, 3), blue first: corners with their numbers, and a line of text below."""
    out = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
    h, w = grey.shape
    scale = max(w / 1280.0, 0.4)
    if view is not None:
        for number, (x, y) in zip(view.ids.tolist(), view.pixels, strict=True):
            at = (round(float(x)), round(float(y)))
            cv2.circle(out, at, max(2, round(5 * scale)), _GOOD, max(1, round(2 * scale)))
            cv2.putText(out, str(number), (at[0] + 5, at[1] - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.4 * scale, _GOOD, 1)
    bar = round(40 * scale)
    cv2.rectangle(out, (0, h - bar), (w, h), _GOOD if view is not None else _BAD, -1)
    plain = said.encode("ascii", "replace").decode()  # what OpenCV's letters can write
    cv2.putText(out, plain, (8, h - bar // 3), cv2.FONT_HERSHEY_SIMPLEX, 0.75 * scale, _PAPER, max(1, round(2 * scale)))
    return np.asarray(out)
