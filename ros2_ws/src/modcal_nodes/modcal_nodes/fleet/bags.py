"""Which recordings are meant, and what each is called among the results."""

from __future__ import annotations

import glob
import hashlib
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

from modcal_core.errors import BadRecording, BadTable
from modcal_msgs_py.bag_files import SUFFIXES

_WILD = re.compile(r"[*?[]")
FOLDER, URDF = "folder", "urdf"


def find_bags(given: Iterable[str], leave_out: Path) -> list[Path]:
    """The bags (absolute paths, sorted, each once) that are named, lie in named folders, or match named patterns.

    leave_out: a folder that is not searched. Raises BadRecording for a name that leads to no bag.
    """
    found: set[Path] = set()
    for name in given:
        paths = [Path(name)] if Path(name).exists() or not _WILD.search(name) else sorted(_matches(name))
        if not any(path.exists() for path in paths):
            raise BadRecording(name, "does not exist", "give bags, folders that hold bags, or a pattern")
        bags = [bag.resolve() for path in paths for bag in _below(path, leave_out.resolve())]
        if not bags:
            raise BadRecording(name, "holds no bag", "give bag folders, .mcap or .db3 files, or a folder above them")
        found.update(bags)
    return sorted(found)


def _matches(pattern: str) -> Iterator[Path]:
    return (Path(path) for path in glob.glob(pattern, recursive=True))


def _below(path: Path, leave_out: Path) -> Iterator[Path]:
    """The path itself where it is a bag, else the bags in it."""
    if path.is_file():
        yield path
        return
    inside = sorted(file for file in path.iterdir() if file.is_file() and file.name.endswith(SUFFIXES))
    # a recorder that was stopped leaves no metadata, but files that are named after their folder
    if (path / "metadata.yaml").is_file() or (inside and all(f.name.startswith(f"{path.name}_") for f in inside)):
        yield path
        return
    yield from inside
    for folder in sorted(p for p in path.iterdir() if p.is_dir() and not p.name.startswith(".")):
        if folder.resolve() != leave_out:
            yield from _below(folder, leave_out)


def names_of(bags: Iterable[Path]) -> dict[Path, str]:
    """For each bag a name that stays when others come: its folder's and its own; of equals, with digits of the path."""
    plain = {bag: f"{bag.parent.name or 'bag'}/{bag.stem if bag.is_file() else bag.name}" for bag in bags}
    count = Counter(plain.values())
    return {bag: name if count[name] == 1 else f"{name}-{_digits(bag)}" for bag, name in plain.items()}


def _digits(bag: Path) -> str:
    return hashlib.sha256(str(bag).encode()).hexdigest()[:8]


def robot_namer(rule: str) -> re.Pattern[str] | None:
    """The pattern that finds a robot's name in a path; None for the rules "folder" and "urdf". Raises BadTable."""
    if rule in (FOLDER, URDF):
        return None
    try:
        pattern = re.compile(rule)
    except re.error as error:
        raise BadTable(
            f"--robot-by {rule}", f"is not a valid pattern: {error}", "give folder, urdf or a pattern"
        ) from error
    if pattern.groups != 1:
        raise BadTable(f"--robot-by {rule}", f"has {pattern.groups} groups, 1 is needed", "put the name in (…)")
    return pattern


def robot_of_bag(bag: Path, model: str | None, rule: str) -> str:
    """Which robot a bag is of: the folder it lies in, what its description says, or what the pattern finds."""
    pattern = robot_namer(rule)
    if pattern is not None:
        found = pattern.search(str(bag))
        return found.group(1) if found is not None and found.group(1) else "unknown"
    return (model or "unknown") if rule == URDF else bag.parent.name
