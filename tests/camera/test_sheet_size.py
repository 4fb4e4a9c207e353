"""A sheet of another size than stated, and what its measured lengths are worth, with arms in MuJoCo."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from camera.boards import BOARD, views
from camera.fits import AS_DRAWN, MEASURED, solved, true_error
from camera.scenes import scene

from modcal_core.camera.claim import APPLY, CANNOT_TELL, DO_NOT_APPLY
from modcal_core.camera.target_file import RULER_STD_M, scale_of_rulers
from modcal_core.camera.views import postures_in_view


@pytest.mark.slow
def test_without_anything_metric_nothing_can_be_told() -> None:
    s = scene(1, True, count=15, board=BOARD)
    r = solved(s)
    assert r.claim.decision.word == CANNOT_TELL
    assert "rulers" in r.claim.decision.because[0]
    whole, known = r.claim.shares["print scale"]
    assert known < 0.5 * whole  # which is what a ruler would tell


@pytest.mark.slow
def test_a_sheet_of_another_size_is_named() -> None:
    """Printed 5 % too large, and measured by nobody; the arm is known to a millimetre."""
    s = scene(4, True, count=15, length_std=3e-4, angle_std=5e-4, printed=1.05 * BOARD.points)
    r = solved(s, arm_m=1e-3)
    assert r.claim.decision.word == DO_NOT_APPLY
    assert re.search(r"\+(4\.9|5\.[01]) % \(x\)", r.claim.decision.because[0])


@pytest.mark.slow
def test_squares_of_another_size_are_named() -> None:
    """Printed 10 % too large: the arm's links could take it up, which no arm is built like."""
    s = scene(21, True, count=15, length_std=1e-3, angle_std=2e-3, printed=1.1 * BOARD.points, board=MEASURED)
    r = solved(s)
    assert r.claim.decision.word == DO_NOT_APPLY
    assert re.search(r"a sheet \+(9|10)\.", r.claim.decision.because[0])
    assert "scale than its URDF" in r.claim.decision.because[0]


@pytest.mark.slow
def test_a_sheet_that_a_bad_arm_hides_is_not_trusted() -> None:
    """Rulers stated at their nominal lengths, a sheet 2 % larger, an arm 4 mm off a body: images do not decide, which is
    said, with what would tell, and how far off the arm could be were the size wrong.
    """
    s = scene(33, False, count=20, length_std=4e-3, angle_std=5e-3, board=AS_DRAWN, printed=1.02 * BOARD.points)
    r = solved(s)
    q = postures_in_view(r.fit, np.random.default_rng(1))
    assert r.claim.decision.word == CANNOT_TELL
    assert "state how well (--measured-to-mm)" in r.claim.decision.because[0]
    assert r.claim.rests_on is not None
    assert true_error(s, r.fit, q) < r.claim.rests_on.if_wrong_m
    assert any("look much alike" in said or "a sheet +" in said for said in r.claim.decision.because)
    clean = solved(replace(s, board=MEASURED, views=views(np.random.default_rng(0), s.T, board=s.board)))
    assert clean.claim.decision.word == APPLY
    assert clean.claim.in_view.interval[2] < 4e-3
    assert "rests on the sheet's stated size" in clean.claim.decision.because[-1]


def test_rulers_of_which_nobody_says_how_well_they_were_read_count_as_any_statement() -> None:
    """One in twenty is of another sheet, whatever the images say against it; of rulers that were read with care that
    is up to the images.
    """
    s = scene(34, True, count=12, length_std=4e-3, angle_std=5e-3)
    found = {}
    for std in (None, RULER_STD_M):
        board = replace(BOARD, scale=scale_of_rulers((0.2, 0.12), (0.2008, 0.1205), "rulers", std))
        found[std] = solved(replace(s, board=board), look_for_effects=False).claim
    assert found[None].in_view.by["size"].chance >= 0.0499
    assert "look much alike" in found[None].decision.doubtful[0]
    assert found[RULER_STD_M].in_view.by["size"].chance < 0.03
