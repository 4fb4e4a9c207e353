"""Which files a bag is made of."""

from __future__ import annotations

from pathlib import Path

import yaml

from modcal_core.errors import BadRecording


def bag_files(path: Path) -> tuple[list[Path], list[str]]:
    """The MCAP files of a bag, in order, and what a person should know of the folder."""
    if not path.exists():
        raise BadRecording(str(path), "does not exist", "give a bag folder or a .mcap file")
    if path.is_file():
        return [path], []
    metadata = path / "metadata.yaml"
    found = sorted(path.glob("*.mcap"), key=lambda p: (len(p.name), p.name))
    if metadata.is_file():
        try:
            information = yaml.safe_load(metadata.read_text(encoding="utf-8"))["rosbag2_bagfile_information"]
            names = [path / Path(name).name for name in information["relative_file_paths"]]
        except (yaml.YAMLError, KeyError, TypeError, UnicodeDecodeError) as error:
            raise BadRecording(
                str(metadata), f"is damaged ({type(error).__name__})", "remove it; the .mcap is enough"
            ) from error
        missing = [name for name in names if not name.is_file()]
        if missing:
            raise BadRecording(str(missing[0]), "is named by metadata.yaml but not there", "put the file back")
        if any(name.suffix != ".mcap" for name in names):
            raise BadRecording(str(names[0]), "is not MCAP", "convert it: ros2 bag convert, with storage_id mcap")
        return names, []
    if found:
        return found, [f"{path.name} has no metadata.yaml: the recorder was stopped before it could close the bag."]
    if any(path.glob("*.db3")):
        raise BadRecording(str(path), "is a SQLite bag", "convert it: ros2 bag convert, with storage_id mcap")
    raise BadRecording(str(path), "holds no .mcap file", "give a bag folder or a .mcap file")
