"""A bag as a user of the library holds it: whose it is, and the samples that it gives."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from itertools import chain as chained
from pathlib import Path

from modcal_core.errors import BadRobot
from modcal_core.measurements import Origin, Recording, Samples, Stretch
from modcal_core.preprocess import prepare_pieces
from modcal_core.robot import Robot
from modcal_msgs_py.mcap_read import read_pieces
from modcal_msgs_py.messages import began, digest, instruments
from modcal_msgs_py.topics import Topics

_CLOCK_LIMIT = 0.5  # s


@dataclass(frozen=True)
class Bag:
    """Bag of joint states and readings.

    path: folder or file. topics: topics stated for roles. recording: the beginning of the bag, or all of a short one.
    heard: called with the share of the bag that has been read.
    """

    path: Path
    topics: Topics
    recording: Recording
    heard: Callable[[float], None] = lambda share: None
    _pieces: list[Iterator[Stretch]] = field(default_factory=list, repr=False, compare=False)

    def robot(self, base: str | None = None, tip: str | None = None) -> Robot:
        """The robot that the bag describes, from base to tip link. Raises BadRobot where it describes none."""
        if self.recording.robot_description is None:
            remedy = "give its URDF, or record the topic"
            raise BadRobot(self.recording.source, "holds no robot_description", remedy)
        return Robot.from_urdf(self.recording.robot_description, base, tip, self.joints)

    @property
    def joints(self) -> frozenset[str]:
        """Names of the joints that were recorded."""
        return frozenset(name for track in self.recording.joints for name in track.names)

    def samples(self, robot: Robot, clock_limit: float = _CLOCK_LIMIT) -> Samples:
        """The samples of the whole bag for this robot: checked, on one clock, cut into stations.

        clock_limit: largest offset between the clocks of tracker and joints that is corrected [s]. The samples' origin
        says what was noticed and left out. Raises BadRecording for what cannot be used.
        """
        prepared = prepare_pieces(self._read(), robot.mechanism, clock_limit=clock_limit)
        first = self.recording
        origin = Origin(
            title=Path(first.source).name,
            notes=prepared.notes,
            dropped=prepared.dropped,
            doubts=prepared.doubts,
            began=began(first),
            sha256=digest(self.path),
            instrument=instruments(first, set(prepared.samples.frames)),
            description=first.robot_description,
            by_type=tuple(reading.topic for reading in first.readings if reading.by_type),
            instrument_mm=prepared.stated.instrument_mm,
            instrument_deg=prepared.stated.instrument_deg,
        )
        return replace(prepared.samples, origin=origin)

    def _read(self) -> Iterator[Stretch]:
        """All pieces; the first time, behind the one that was read already."""
        return self._pieces.pop() if self._pieces else read_pieces(self.path, heard=self.heard, topics=self.topics)


def read_bag(
    path: str | Path,
    topics: Topics | Iterable[str] = (),
    ignore: Iterable[str] = (),
    tf: str | None = None,
    heard: Callable[[float], None] = lambda share: None,
) -> Bag:
    """A bag, MCAP or SQLite, a folder or a file; a cut one is read as far as it goes.

    topics: ROLE=NAME of topics that do not have the names of docs/bags.md, such as ``tracker/pose=/vrpn/tool/pose``.
    ignore: topics that are left out. tf: PARENT:CHILD, frames of /tf that are the tracker's reading. heard: is told the
    share that has been read. Raises BadRecording for what is no bag, and BadTable for what is said of topics.
    """
    said = topics if isinstance(topics, Topics) else Topics.of(topics, ignore, tf)
    pieces = read_pieces(Path(path), heard=heard, topics=said)
    first = next(pieces)
    return Bag(Path(path), said, first.recording, heard, [chained([first], pieces)])
