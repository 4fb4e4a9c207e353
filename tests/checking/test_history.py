"""What grows over a robot's calibrations, and what does not."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from cells import record, ur10

from modcal_core.calibration.store import Calibration
from modcal_core.effects.effect import Effect
from modcal_core.effects.shapes import Shape
from modcal_core.moves.history import series_of
from modcal_core.public import calibrate
from modcal_core.robot import Robot
from modcal_nodes.cli.main import run

DAY = 86400.0


def entries(
    values: list[float], std: float = 0.1, size: bool = True
) -> list[tuple[str, float, dict[str, tuple[str, float, float, bool]]]]:
    return [(f"e{i}", 30.0 * DAY * i, {"curve of j3": ("mrad", v, std, size)}) for i, v in enumerate(values)]


def test_growth_is_said_with_its_share() -> None:
    rng = np.random.default_rng(1)
    (series,) = series_of(entries(list(2.0 + 0.1 * np.arange(5) + 0.01 * rng.standard_normal(5)), std=0.02))
    assert series.trend is not None
    assert series.trend.low < 0.4 < series.trend.high
    assert series.trend.share == pytest.approx(0.2, abs=0.03)
    assert series.sentence.startswith("The curve of j3 grew by 0.")
    assert series.sentence.endswith("% in 4 months.")


def test_of_noise_alone_few_series_have_a_trend() -> None:
    rng = np.random.default_rng(2)
    names = [f"zero of j{k}" for k in range(8)]
    found = 0
    for _ in range(300):
        draw = 0.1 * rng.standard_normal((4, 8))
        own = [(f"e{i}", i * DAY, {n: ("mrad", float(v), 0.1, False) for n, v in zip(names, draw[i], strict=True)})
               for i in range(4)]  # fmt: skip
        found += any(s.trend is not None for s in series_of(own))
    assert found <= 9  # 1 % of 300 is three; more than nine once in two thousand


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    """An arm with a gear's wave on its elbow."""
    found = calibrate(Robot(ur10()), record(3, 60).samples, geometry_only=True).calibration
    wave = Effect(
        "gear_harmonic", "elbow_joint", "axis", "position:elbow_joint", Shape("turn", {"cycles": 1.0}),
        np.array([1e-3, 0.0]), np.array([1e-5, 1e-5]),
    )  # fmt: skip
    return replace(found, calibrated=found.calibrated.with_effects((wave,)), uncertainty=found.uncertainty and replace(
        found.uncertainty, covariance=np.pad(found.uncertainty.covariance, (0, 2))
    ))  # fmt: skip


@pytest.mark.slow
def test_the_verb_reads_a_folder(calibration: Calibration, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    begin = datetime(2026, 3, 1, tzinfo=UTC)
    (wave,) = calibration.calibrated.effects
    for month in range(5):
        grown = wave.with_values((1.0 + 0.05 * month) * wave.values, wave.std)
        part = tmp_path / f"c{month}"
        part.mkdir()
        replace(calibration, calibrated=calibration.calibrated.with_effects((grown,))).save(part / "calibration.yaml")
        date = (begin + timedelta(days=30 * month)).isoformat()
        (part / "report.json").write_text(json.dumps({"trace": {"date": date, "robot": "cell 3"}, "verdict": "Fine."}))
    (tmp_path / "k").mkdir()
    (tmp_path / "k" / "check.json").write_text(json.dumps({"date": "2026-04-15T10:00:00Z", "verdict": "Nothing."}))
    assert run(["history", str(tmp_path), "--json"]) == 0
    (robot,) = json.loads(capsys.readouterr().out)["robots"]
    assert robot["robot"] == "cell 3"
    assert [e["what"] for e in robot["entries"]].index("check") == 2  # in order of time
    grows = [s for s in robot["series"] if s["trend"]]
    assert [s["name"] for s in grows] == ["curve of elbow_joint"]
    assert grows[0]["trend"]["share"] == pytest.approx(0.2, abs=0.02)
    assert "elbow_joint grew by" in robot["verdict"]
    assert json.loads((tmp_path / "history.json").read_text())["robots"] == [robot]


def test_a_folder_without_any_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["history", str(tmp_path)]) == 2
    assert "holds no folder of modcal calibrate" in capsys.readouterr().err
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "check.json").write_text("{broken")
    assert run(["history", str(tmp_path)]) == 2
    assert "is not JSON" in capsys.readouterr().err
