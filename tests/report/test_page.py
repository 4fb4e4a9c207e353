"""What every page of a report is made of: sections, pictures with words, one file, colours that can be read."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from html.parser import HTMLParser

import numpy as np
import pytest
from report.reports import COUNT, REPORTS, WRONG, delta, page_of, points, warm_cell

from modcal_core.calibration.data_split import Split
from modcal_core.calibration.noise import Errors
from modcal_core.measurements.dwells import SAME
from modcal_core.measurements.samples import indirect_rows
from modcal_core.outcome.contents import Outcome
from modcal_core.report.blocks import FILES, as_script_data
from modcal_core.report.figures import scene
from modcal_core.report.report import to_json_data

Element = tuple[str, dict[str, str]]


class Elements(HTMLParser):
    """Every start tag of a page, and the texts of its style."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.all: list[Element] = []
        self.open: list[str] = []
        self.unclosed: list[str] = []
        self.feed(page)
        self.unclosed += self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.all.append((tag, {name: value or "" for name, value in attrs}))
        if tag not in ("meta", "input", "br"):
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.all.append((tag, {name: value or "" for name, value in attrs}))

    def handle_endtag(self, tag: str) -> None:
        if not self.open or self.open.pop() != tag:
            self.unclosed.append(tag)

    def of(self, tag: str) -> list[dict[str, str]]:
        return [attributes for name, attributes in self.all if name == tag]


@cache
def page(name: str) -> str:
    return page_of(REPORTS[name](), [file.name for file in FILES])


@cache
def elements(name: str) -> Elements:
    return Elements(page(name))


ALL = pytest.mark.parametrize("name", REPORTS)


@ALL
def test_sections_that_a_report_has(name: str) -> None:
    data = to_json_data(REPORTS[name]())
    assert data["verdict"].split(" mm RMS")[0] in page(name)
    for stage in ("nominal", "final"):
        assert f"{data['error_mm'][stage]['rms']:.3f}" in page(name)
    ids = {attributes.get("id") for attributes in elements(name).of("section")}
    assert {"error", "robot", "residuals", "told", "parameters", "stations", "files"} <= ids
    assert ("effects" in ids) == bool(data["effects"])
    assert ("evidence" in ids) == (name in ("warm", "delta"))


def test_residuals_are_shown_against_joints_time_and_temperature_and_every_step_is_listed() -> None:
    report = warm_cell()
    assert len(report.steps) >= 2
    names = [a["aria-label"] for a in elements("warm").of("svg")]
    for against in (*report.samples.names, "time", "temperature of cell"):
        assert sum(f"against {against}" in n for n in names) == 1, against
    steps = page("warm")[page("warm").index('id="steps"') :]
    assert [float(size) for size in re.findall(r'<td class="n">([\d.]+)</td>', steps)[: len(report.steps)]] == [
        pytest.approx(step.rms_mm, abs=1e-3) for step in report.steps
    ]


def test_stations_that_were_left_out_are_named_with_their_errors() -> None:
    report = warm_cell()
    listed = to_json_data(report)["rejected"]
    assert {row["station"] for row in listed} == set(WRONG)
    # 5 mm along each axis were put in
    assert [row["miss_mm"] for row in listed] == pytest.approx([5.0 * np.sqrt(3.0)] * 3, rel=0.05)
    table = page("warm")[page("warm").index("Rejected stations") :]
    rows = re.findall(r'<tr><th scope="row">(\d+)</th>', table)
    assert {int(r) for r in rows[: len(WRONG)]} == set(WRONG)


def test_the_map_before_and_after() -> None:
    """What was planted explains most at first; when it is in the model, nothing explains much any more."""
    first, last = warm_cell().evidence
    place, direction, driver, share = first.strongest(1)[0]
    assert (place, direction, driver) == ("elbow_joint", "axis", "position:elbow_joint")
    cell = last.share[last.rows.index((place, direction)), last.drivers.index(driver)]
    assert share > 0.3
    assert cell < 0.2 * share
    assert first.p_value < 1e-6 < last.p_value
    assert [d for d in first.drivers if d.startswith("position:")] == [
        f"position:{n}" for n in warm_cell().samples.names
    ]


def test_arrows_are_the_errors_seen_from_the_base() -> None:
    """A rotation keeps lengths, and the tool stands where the model says."""
    for report in (warm_cell(), delta(), points()):
        drawn = scene(report)
        assert drawn is not None
        assert len(drawn.points) == len(report.scored)
        for (_, miss), stage in zip((drawn.stages[0], drawn.stages[-1]), ("nominal", "final"), strict=True):
            norms = np.linalg.norm(miss, axis=1)
            assert 1e-3 * norms == pytest.approx(report.errors[stage].position_norm, rel=1e-3, abs=2e-6)
        assert report.model is not None
        T = report.model.predict_samples(report.scored)
        T_frame_base = report.model.T_frame_base[report.scored.frame]
        in_frame = np.einsum("nij,nj->ni", T_frame_base[:, :3, :3], drawn.points) + T_frame_base[:, :3, 3]
        assert in_frame == pytest.approx(T[:, :3, 3], abs=1e-9)


def test_arrows_of_a_theodolite_stand_across_its_line_of_sight() -> None:
    report = REPORTS["bearings"]()
    drawn, model = scene(report), report.model
    assert drawn is not None
    assert model is not None
    assert "measure along one line only" in page("bearings")
    assert indirect_rows(report.scored).all()
    for frame in range(2):
        rows = report.scored.frame == frame
        eye = -model.T_frame_base[frame, :3, :3].T @ model.T_frame_base[frame, :3, 3]
        sight = drawn.points[rows] - eye
        miss = drawn.stages[0][1][rows]
        along = np.sum(sight * miss, axis=1) / np.linalg.norm(sight, axis=1) / np.linalg.norm(miss, axis=1)
        assert np.abs(along).max() < 0.02


def test_a_delta_has_three_arms_that_meet() -> None:
    drawn = scene(delta())
    assert drawn is not None
    for arm in drawn.arms:
        ends = np.array([path[-1] for path in arm[:3]])
        assert len(arm) == 4
        assert np.ptp(ends, axis=0).max() == 0.0
    # rods are as long as the drawing says, but for the calibration's millimetres
    rods = [np.linalg.norm(path[3] - path[2]) for arm in drawn.arms for path in arm[:3]]
    assert np.ptp(rods) < 5e-3


def test_names_from_outside_cannot_break_the_page() -> None:
    assert "warm &lt;cell&gt; &amp; more" in page("warm")
    assert "</script" not in as_script_data({"name": "</script><b>"})


def repeated(report: Outcome, times: int) -> Outcome:
    """The same recording over and over, each time later and at stations of its own, a little beside the last ones."""
    n = len(report.samples)
    long = report.samples.select(np.tile(np.arange(n), times))
    later = np.repeat(np.arange(times), n)
    span, most = float(np.ptp(long.stamps)) + 1.0, int(long.station.max()) + 1
    samples = replace(
        long,
        stamps=long.stamps + span * later,
        station=long.station + most * later,
        q=long.q + 2.0 * SAME * later[:, None],
    )

    def rows(part: np.ndarray) -> np.ndarray:
        return (part + n * np.arange(times)[:, None]).ravel()

    def again(errors: Errors) -> Errors:
        return Errors(np.tile(errors.position, (times, 1)), np.tile(errors.rotation, (times, 1)))

    sets = Split(*(rows(part) for part in (report.sets.train, report.sets.explain, report.sets.held_out)), "station")
    wrong = np.tile(report.wrong, times)
    return replace(
        report,
        samples=samples,
        sets=sets,
        scored=samples.select(sets.held_out[~wrong[sets.held_out]]),
        errors={stage: again(errors) for stage, errors in report.errors.items()},
        steps=tuple(replace(step, errors=again(step.errors)) for step in report.steps),
        residuals=np.tile(report.residuals, times),
        wrong=wrong,
    )


@pytest.mark.slow
def test_a_long_recording_makes_no_larger_page() -> None:
    """20 000 stations: what is drawn is thinned, and what is counted is not."""
    long = repeated(warm_cell(), -(-20_000 // COUNT))
    assert long.samples.stations >= 20_000
    text = page_of(long, [file.name for file in FILES])
    assert len(text.encode()) < 900_000
    assert len(text.encode()) < 2.5 * len(page("warm").encode())
    assert str(long.samples.stations) in text
    assert f"And {int(long.wrong.sum()) - 30} more; all are in report.json." in text
    # every chart of the residual has at most 400 samples, of each of which three components are drawn
    marks = [len(places.split()) // 2 for places in re.findall(r'<path d="M([^"]+)" fill="none" marker-start', text)]
    assert max(marks) == 400


def test_joint_offsets_come_first_and_no_table_mixes_units() -> None:
    text = page("warm")
    assert text.index('id="offsets"') < text.index('id="error"') < text.index('class="expert"')
    for part in ("account", "evidence", "told", "parameters", "steps"):
        assert text.index('class="expert"') < text.index(f'id="{part}"')
    for head in re.findall(r"<thead>(.*?)</thead>", text, re.DOTALL):
        units = set(re.findall(r", (mm|mrad|°|‰)\b|, (°)", re.sub(r"<[^>]+>", ";", head)))
        assert len(units) <= 1, head


@pytest.mark.slow
def test_an_evaluation_is_named_after_its_calibration() -> None:
    report = replace(points(), searched=None)
    assert "<title>cell_3, evaluated on recording</title>" in page_of(report, calibration="cell_3")
