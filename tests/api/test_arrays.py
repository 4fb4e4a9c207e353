"""Samples from arrays: what becomes of each argument, and what is refused."""

from __future__ import annotations

import sys
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import modcal
from modcal_core.errors import BadRecording, ModcalError

N = 20
Q = np.linspace(-1.0, 1.0, N * 3).reshape(N, 3)
P = np.linspace(0.0, 1.0, N * 3).reshape(N, 3)


def test_rows_without_stamps_are_stations_in_order() -> None:
    samples = modcal.Samples.from_arrays(Q, points=P, sigma=2e-5)
    assert len(samples) == samples.stations == N
    assert samples.names == ()
    assert not samples.clock
    assert np.array_equal(samples.q, Q)
    assert np.array_equal(samples.reading, P)
    assert (samples.sigma_position == 2e-5).all()
    assert np.array_equal(samples.approach[1:], np.ones((N - 1, 3)))  # from the row before
    assert not samples.moving.any()


def test_a_log_of_a_moving_arm_is_cut_into_dwells() -> None:
    t = np.arange(0.0, 20.0, 0.02)
    course = np.interp(t % 5.0 + 5.0 * (t // 5.0), [0, 3, 5, 8, 10, 13, 15, 18, 20], [0, 0, 1, 1, 2, 2, 3, 3, 3])
    q = course[:, None] * np.ones(3)
    samples = modcal.Samples.from_arrays(q, points=q + 1.0, stamps=t)
    assert samples.stations == 4
    assert np.allclose(samples.q[:, 0], [0, 1, 2, 3], atol=1e-3)
    assert samples.clock


def test_poses_in_either_form() -> None:
    from scipy.spatial.transform import Rotation

    R = Rotation.from_rotvec(P)
    T = np.tile(np.eye(4), (N, 1, 1))
    T[:, :3, :3], T[:, :3, 3] = R.as_matrix(), P
    one = modcal.Samples.from_arrays(Q, poses=T)
    two = modcal.Samples.from_arrays(Q, poses=np.c_[P, R.as_quat()])
    assert np.allclose(one.R, two.R, atol=1e-12)
    assert np.allclose(one.R, R.as_matrix(), atol=1e-12)
    assert one.kinds == two.kinds == ("pose",)


class Frame(dict[str, np.ndarray]):
    """As much of a DataFrame as is asked for; pandas is not needed."""

    columns = property(lambda self: list(self))

    def __getitem__(self, key: str | list[str]) -> Any:
        values = (
            dict.__getitem__(self, key) if isinstance(key, str) else np.stack([self[k].values for k in key], axis=1)
        )
        return SimpleNamespace(values=values, to_numpy=lambda kind: values.astype(kind))


def test_a_frame_there_and_back(monkeypatch: pytest.MonkeyPatch) -> None:
    turns = np.tile([0.0, 0.6, 0.0, 0.8], (N, 1))
    table = Frame(
        zip(
            ["a", "b", "c", "x", "y", "z", "i", "j", "k", "r", "t", "s"],
            np.c_[Q, P, turns, 10.0 * np.arange(N), np.full(N, 3e-5)].T,
            strict=True,
        )
    )
    joints, pose = ["a", "b", "c"], ["x", "y", "z", "i", "j", "k", "r"]
    samples = modcal.Samples.from_frame(table, joints, pose, stamps="t", sigma="s", frame="left")
    assert (samples.names, samples.frames, samples.clock) == (("a", "b", "c"), ("left",), True)
    assert (samples.sigma_position == 3e-5).all()
    monkeypatch.setitem(sys.modules, "pandas", SimpleNamespace(DataFrame=dict))
    again = samples.to_frame()
    assert list(again) == [*joints, "stamp", "station", "frame", "kind", "x", "y", "z", "qx", "qy", "qz", "qw"]
    assert np.array_equal(np.stack([again[k] for k in joints], axis=1), Q)
    assert np.allclose(np.abs(again["qy"]), 0.6, atol=1e-12)
    with pytest.raises(BadRecording, match="column d: is not in the frame: choose among a, b"):
        modcal.Samples.from_frame(table, ["d"], pose)


def test_ranges_to_anchors_with_gaps() -> None:
    near = np.linspace(1.0, 2.0, N)
    near[3] = np.nan
    samples = modcal.Samples.from_arrays(Q, ranges={"a": near, "b": np.linspace(2.0, 3.0, N)})
    assert samples.frames == ("a", "b")
    assert [(samples.frame == f).sum() for f in (0, 1)] == [N - 1, N]
    assert samples.stations == N
    assert samples.kinds == ("range",)


def test_drivers_travel_along() -> None:
    samples = modcal.Samples.from_arrays(
        Q, points=P, stamps=100.0 + 10.0 * np.arange(N), temperatures={"elbow": np.arange(N)},
        signals={"pressure": np.ones(N)}, efforts=2.0 * Q, frame="laser",
    )  # fmt: skip
    assert [track.name for track in samples.signals] == ["temperature:elbow", "signal:pressure"]
    assert np.allclose(samples.effort, 2.0 * Q, atol=1e-12)
    assert samples.frames == ("laser",)
    assert samples.origin.began == 100.0


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({}, "none of points, poses and ranges"),
        ({"points": P, "poses": np.tile(np.eye(4), (N, 1, 1))}, "points and poses are given"),
        ({"points": P[:5]}, "points"),
        ({"points": P[:, :2]}, r"not \(20, 3\)"),
        ({"poses": np.ones((N, 7))}, "quaternion of row 0"),
        ({"poses": np.ones((N, 4, 4))}, "not a rotation matrix"),
        ({"points": P, "names": ["a", "b"]}, "2 names for 3 columns"),
        ({"points": P, "names": ["a", "b", "b"]}, "2 names for 3 columns"),
        ({"points": P, "stamps": np.zeros(N)}, "do not increase at row 1"),
        ({"points": P, "sigma": -1.0}, "sigma"),
        ({"points": P, "sigma": np.ones(3)}, "sigma"),
        ({"points": P, "efforts": np.ones((N, 2))}, "efforts"),
        ({"points": P, "temperatures": {"x": np.full(N, np.nan)}}, "temperature x, row 0"),
        ({"points": P, "q": np.where(np.arange(N)[:, None] == 7, np.nan, Q)}, "q, row 7"),
        ({"points": P, "q": "abc"}, "not an array of numbers"),
        ({"points": np.full((N, 3), np.nan)}, "no reading that is finite"),
        ({"q": np.empty((0, 3)), "points": np.empty((0, 3))}, "hold no row"),
    ],
)
def test_what_does_not_fit_together_is_refused(arguments: dict[str, object], said: str) -> None:
    with pytest.raises(ModcalError, match=said):
        modcal.Samples.from_arrays(**{"q": Q, **arguments})  # type: ignore[arg-type]


def test_a_track_takes_matrices_and_refuses_both() -> None:
    T = np.tile(np.eye(4), (N, 1, 1))
    T[:, :3, 3] = P
    assert np.array_equal(modcal.Track.from_arrays(poses=T).positions, P)
    with pytest.raises(BadRecording, match="points and poses"):
        modcal.Track.from_arrays(points=P, poses=T)
    with pytest.raises(BadRecording, match="neither"):
        modcal.Track.from_arrays()
