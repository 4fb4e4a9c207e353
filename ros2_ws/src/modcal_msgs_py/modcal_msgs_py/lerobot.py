"""Data sets of LeRobot: a leader's joints beside a follower's, episode by episode, in Parquet files.

``observation.state`` is where the follower's joints were, ``action`` where the leader's were, which the follower was
told to go to. Degrees become radians where values exceed two turns of a radian; normalised values stay as they are.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from modcal_core.errors import BadRecording
from modcal_core.files import read_json
from modcal_core.geometry import Array
from modcal_core.measurements import JointTrack, Recording

_INFO = Path("meta") / "info.json"
_STATE, _ACTION = "observation.state", "action"
_TURNS = 4.0 * np.pi  # rad, beyond which values are degrees
_DAY = 86400.0  # s from one episode to the next, for a data set has no clock


def is_lerobot(folder: Path) -> bool:
    """Whether a folder is such a data set."""
    return (folder / _INFO).is_file()


def episodes_of(folder: Path) -> list[tuple[str, Recording]]:
    """Names and recordings of the episodes of a data set, in order. Raises BadRecording for one that cannot be used."""
    import pyarrow
    import pyarrow.parquet as parquet

    info = read_json(folder / _INFO, "copy the data set again")
    files = sorted((folder / "data").rglob("*.parquet"))
    try:
        features = info["features"]
        said = features[_STATE]["names"]
        names = [n for part in said.values() for n in part] if isinstance(said, dict) else list(said or ())
        told = features[_ACTION]["names"]
        acted = [n for part in told.values() for n in part] if isinstance(told, dict) else list(told or ())
        tables = [parquet.read_table(f, columns=[_STATE, _ACTION, "timestamp", "episode_index"]) for f in files]
        columns = pyarrow.concat_tables(tables).to_pydict()
        state, action = (np.array(columns[key], dtype=float) for key in (_STATE, _ACTION))
        if state.shape[1] != len(names) or action.shape[1] != len(acted) or set(names) - set(acted):
            raise ValueError("action and observation.state do not name the same joints")
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, pyarrow.ArrowInvalid) as error:
        said_of = f"is no data set of a leader and a follower ({type(error).__name__}: {str(error)[:80]})"
        raise BadRecording(
            str(folder), said_of, "give one with meta/info.json, action and observation.state"
        ) from error
    factor = np.pi / 180.0 if np.abs(state).max(initial=0.0) > _TURNS else 1.0
    plain = tuple(str(n).removesuffix(".pos") for n in names)
    order = [acted.index(n) for n in names]
    episode, t = np.array(columns["episode_index"]), np.array(columns["timestamp"], dtype=float)
    out = []
    for k in np.unique(episode):
        rows = episode == k
        stamps = _DAY * float(k) + t[rows]
        tracks = (_track(plain, stamps, factor * x, topic) for x, topic in (
            (state[rows], "/joint_states"), (action[rows][:, order], "/leader")))  # fmt: skip
        follower, leader = tracks
        source = f"{folder.name} {int(k)}"
        out.append((source, Recording((follower,), commands=(leader,), source=source)))
    return out


def _track(names: tuple[str, ...], stamps: Array, q: Array, topic: str) -> JointTrack:
    unknown = np.full(q.shape, np.nan)
    return JointTrack(names, stamps, q, unknown, unknown, np.full(len(stamps), np.nan), topic)
