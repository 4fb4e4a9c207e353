"""Base, tool, sockets and arm together: recordings on which the nominal arm puts the tool in the wrong place."""

from __future__ import annotations

import sys
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from modcal_core.calibration.cell import Cell, fit_cell, free_cell, with_sockets
from modcal_core.calibration.distances import Distance
from modcal_core.calibration.fit import Fit, identify
from modcal_core.calibration.known_distances import contradicted_together, distances_of, scale_without_distances
from modcal_core.calibration.noise import errors
from modcal_core.calibration.placing import Known
from modcal_core.calibration.starts import fit_geometry
from modcal_core.calibration.stated import StatedTool, contradicted_places
from modcal_core.calibration.structure import choose_parameters, views_of
from modcal_core.errors import BadTable
from modcal_core.geometry import se3
from modcal_core.measurements.samples import Samples
from modcal_core.preprocess import prepare
from modcal_core.robots.urdf import read_chain
from modcal_nodes.io.inputs import read_cell

sys.path.append(str(Path(__file__).resolve().parents[2] / "bench" / "fits"))
from hard_cells import DISTANCE, KINDS, Fitted, cube, sockets

MAX = 1.1  # times the floor


def halves(made: Fitted, cell: Cell) -> tuple[Samples, Samples]:
    """Every other sample, to fit and to judge."""
    chain = read_chain(made.urdf, tip=made.tip)
    samples = with_sockets(prepare(made.recording, chain).samples, cell, chain)
    rows = np.arange(len(samples))
    return samples.select(rows[::2]), samples.select(rows[1::2])


def fitted(made: Fitted, cell: Cell, samples: Samples, together: bool = True) -> Fit:
    """The fit of the geometry; not together: about where the nominal arm has base and tool, as arms are from drawings."""
    chain = read_chain(made.urdf, tip=made.tip)
    nominal = fit_cell(chain, samples, cell)
    parameters = choose_parameters(nominal.model, views_of(samples), cell.kept, cell.distances).parameters
    if not together:
        return identify(nominal.model, samples, parameters, cell.distances)
    return fit_geometry(nominal.model, samples, free_cell(parameters, cell), cell)


def missed(fit: Fit, samples: Samples) -> float:
    """RMS [mm] of what a fit leaves of samples."""
    return 1e3 * float(np.sqrt(np.mean(errors(fit.model, samples).position_norm ** 2)))


@pytest.mark.slow
def test_a_tool_that_hardly_turns_is_found_with_the_arm() -> None:
    made = cube(np.random.default_rng(1), tilt=5e-4, side=0.4, error=10.0)
    train, rest = halves(made, Cell())
    alone = fitted(made, Cell(), train, together=False)
    fit = fitted(made, Cell(), train)
    assert missed(alone, rest) > 2.0 * made.floor_mm  # what about the nominal arm's tool came to
    assert missed(fit, rest) < MAX * made.floor_mm
    assert (
        np.linalg.norm(fit.model.T_tip_tool[:3, 3] - made.tool)
        < 0.05
        < np.linalg.norm(alone.model.T_tip_tool[:3, 3] - made.tool)
    )
    assert fit.converged


@pytest.mark.slow
def test_sockets_with_a_known_distance_are_found_with_the_arm() -> None:
    made = sockets(np.random.default_rng(1), placements=4, error=12.0)
    cell = Cell(tuple(Distance(pair, DISTANCE) for pair in made.distances))
    train, rest = halves(made, cell)
    fit = fitted(made, cell, train)
    estimated = np.sqrt(1.0 + len(fit.parameters) / (3.0 * len(train)))  # what fitting so many to so few adds
    assert missed(fit, rest) < MAX * estimated * made.floor_mm
    alone = fitted(made, cell, train, together=False)
    assert missed(alone, rest) > 5.0 * made.floor_mm  # what about the nominal arm's sockets came to
    assert max(abs(d.residual) for d in distances_of(fit, train, cell.distances)) < 2e-4  # m, four deviations


@pytest.fixture(scope="module")
def socketed() -> Fitted:
    """Two hundred and forty postures about eight sockets, of which four pairs are 50 mm apart."""
    return sockets(np.random.default_rng(2), placements=4, error=4.0)


@pytest.mark.slow
@pytest.mark.parametrize("stated", [1.0, 1.12])
def test_fixed_points_say_nothing_of_scale(socketed: Fitted, stated: float) -> None:
    """By themselves they draw all lengths together by a tenth, which is no evidence against a right distance."""
    known = tuple(Distance(pair, stated * DISTANCE) for pair in socketed.distances)
    cell = Cell(known, sockets=tuple(name for pair in socketed.distances for name in pair))
    train, _ = halves(socketed, cell)
    fit = fitted(socketed, cell, train)
    assert bool(contradicted_together(fit, train, known)) == (stated != 1.0)
    single = replace(cell, distances=known[:1])
    (alone,) = distances_of(fitted(socketed, single, train), train, single.distances)
    assert abs(alone.found - DISTANCE) < 3.0 * alone.std < 0.1 * DISTANCE
    assert alone.contradicted == (stated != 1.0)


@pytest.fixture(scope="module")
def good() -> Fitted:
    """The same of an arm whose bodies are within half a millimetre of the drawing."""
    return sockets(np.random.default_rng(300), placements=4, error=1.0)


@pytest.mark.slow
@pytest.mark.parametrize("stated", [1.0, 1.015])
def test_how_far_the_lengths_are_off_tells_how_well_the_drawing_knows_the_scale(good: Fitted, stated: float) -> None:
    """Three quarters of a millimetre on fifty, of an arm that is else as it is drawn: its lengths are not 1.5 % off."""
    known = tuple(Distance(pair, stated * DISTANCE) for pair in good.distances)
    cell = Cell(known, sockets=tuple(name for pair in good.distances for name in pair))
    train, _ = halves(good, cell)
    fit = fitted(good, cell, train)
    scale = scale_without_distances(fit, train, known)
    assert abs(stated * (1.0 + scale.longer) - 1.0) < 3.0 * scale.std < 0.01  # wherever the fit had its base
    assert bool(contradicted_together(fit, train, known)) == (stated != 1.0)


def test_a_long_valley_ends_where_the_readings_show_no_more() -> None:
    """A tool that turns by the arm's errors alone: where it is trades with these, far and along a bend."""
    made = KINDS["cube_one_orientation"](np.random.default_rng([zlib.crc32(b"cube_one_orientation"), 104]))
    train, rest = halves(made, Cell())
    fit = fitted(made, Cell(), train)
    assert fit.converged
    assert missed(fit, rest) < 1.2 * made.floor_mm


def test_a_stated_tool_is_held_within_its_tolerance() -> None:
    made = cube(np.random.default_rng(3), tilt=0.0, side=0.3, error=6.0)
    drawn = made.tool + np.array([1e-4, -1e-4, 5e-5])
    cell = Cell(tool=StatedTool(se3.transform(p=drawn), 1e-4))
    train, rest = halves(made, cell)
    fit = fitted(made, cell, train)
    assert np.linalg.norm(fit.model.T_tip_tool[:3, 3] - drawn) < 4e-4
    assert np.linalg.norm(fitted(made, Cell(), train).model.T_tip_tool[:3, 3] - drawn) > 5e-3
    assert missed(fit, rest) < MAX * made.floor_mm
    assert contradicted_places(fit, cell.tool, cell.known) == ()


def test_a_stated_tool_that_is_elsewhere_is_contradicted() -> None:
    made = cube(np.random.default_rng(4), tilt=0.5, side=0.3)
    cell = Cell(tool=StatedTool(se3.transform(p=made.tool + np.array([0.0, 0.02, 0.0])), 1e-3))
    fit = fitted(made, cell, halves(made, cell)[0])
    (said,) = contradicted_places(fit, cell.tool, cell.known)
    assert "tool" in said
    assert "1.000 mm" in said


def test_a_stated_base_is_held_within_its_tolerance() -> None:
    made = cube(np.random.default_rng(5), tilt=0.5, side=0.3)
    train, _ = halves(made, Cell())
    free = fitted(made, Cell(), train)
    elsewhere = free.model.T_frame_base[0] @ se3.transform(p=np.array([0.002, 0.0, 0.0]))
    cell = Cell(known=(Known("tracker", "base", elsewhere, (1e-5, 1e-4)),))
    held = fitted(made, cell, train)
    gap = np.linalg.norm(held.model.T_frame_base[0, :3, 3] - elsewhere[:3, 3])
    assert gap < 2e-4 < np.linalg.norm(free.model.T_frame_base[0, :3, 3] - elsewhere[:3, 3])


def test_the_cell_file_states_tool_and_base(tmp_path: Path) -> None:
    file = tmp_path / "cell.yaml"
    file.write_text(
        "tool: {position_m: [0, 0, 0.055], std_m: 0.001}\ngravity: [0, -9.81, 0]\n"
        "known:\n  - {frame: tracker, in: base, position_m: [1, 2, 3], std_m: 0.002, std_deg: 0.1}\n"
    )
    cell = read_cell(file)
    assert cell.gravity == (0.0, -9.81, 0.0)
    assert cell.tool.T_tip_tool[:3, 3].tolist() == [0.0, 0.0, 0.055]
    assert (cell.tool.std_m, cell.tool.std_rad) == (0.001, np.inf)
    assert cell.known[0].std == pytest.approx((0.002, np.radians(0.1)))
    assert cell.kept == ()  # what is known to a tolerance is fitted within it
    exactly = replace(cell, known=(replace(cell.known[0], std=None),))
    assert exactly.kept == ("frame tracker",)


@pytest.mark.parametrize(
    "text",
    [
        "tool: {position_m: [0, 0, 0.055]}",
        "tool: {position_m: [0, 0, 0.055], std_m: 0}",
        "tool: {position_m: [0, 0, 0.055], std_m: 0.001, std_deg: 1}",
        "known: [{frame: a, in: base, std_m: 0.001}]",
        "known: [{frame: a, in: b, std_m: 0.001, std_deg: 1}]",
        "gravity: [0, 0, 0]",
    ],
)
def test_half_a_statement_is_refused(tmp_path: Path, text: str) -> None:
    file = tmp_path / "cell.yaml"
    file.write_text(text)
    with pytest.raises(BadTable):
        read_cell(file)
