"""Reading and writing files; a folder is written whole or not at all."""

from __future__ import annotations

import json
import os
import re
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from modcal_core.errors import BadTable

_MAX_DEPTH, _MAX_BYTES = 100, 1 << 28  # of a file to be read


def write_folder(folder: Path, files: Mapping[str, str | bytes]) -> None:
    """Write these texts, or bytes, into a folder, made if need be; on failure the folder is left as it was.

    All files are written elsewhere first, on the same disk. A folder that is new is then moved into place at once, into
    one that is there already its files are moved one after the other.
    """
    if folder.exists() and not folder.is_dir():
        raise BadTable(str(folder), "is a file", "give --out a folder")
    with _staged(folder, files) as stage:
        if not folder.exists():
            os.rename(stage / "new", folder)
            return
        for name in files:
            os.replace(stage / "new" / name, folder / name)


def replace_folder(folder: Path, files: Mapping[str, bytes]) -> None:
    """Put a folder with these files, and no others, where this one is or is not yet.

    It is written elsewhere on the same disk and moved into place by renaming, so whoever looks sees the old folder, or
    for a moment none, or the new one, but never a part.
    """
    with _staged(folder, files) as stage:
        if folder.exists():
            os.replace(folder, stage / "old")
        os.replace(stage / "new", folder)


@contextmanager
def _staged(folder: Path, files: Mapping[str, str | bytes] | Mapping[str, bytes]) -> Iterator[Path]:
    """A folder beside this one, gone afterwards, that holds the files in ``new``."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    stage = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    try:
        (stage / "new").mkdir()
        for name, content in files.items():
            (stage / "new" / name).write_bytes(content.encode() if isinstance(content, str) else content)
        yield stage
    finally:
        shutil.rmtree(stage, ignore_errors=True)


def write_file(path: Path, text: str) -> None:
    """Write one file, its folder made if need be; on failure what stood there stays."""
    write_bytes(path, text.encode("utf-8"))


def write_bytes(path: Path, content: bytes) -> None:
    """The same of bytes. Two processes may write it at once."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        part.write_bytes(content)
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def to_json(data: Any) -> str:
    """JSON text; raises ValueError for a number that is not finite, which no reader of ours may meet."""
    return json.dumps(data, indent=1, allow_nan=False) + "\n"


def read_json(path: Path, remedy: str) -> Any:
    """The data of a JSON file; raises BadTable, with this remedy, for one that is none or too large."""
    if path.stat().st_size > _MAX_BYTES:
        raise BadTable(str(path), f"is larger than {_MAX_BYTES >> 20} MiB", remedy)
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise BadTable(str(path), "is not JSON", remedy) from error


def to_yaml(data: Any) -> str:
    """YAML text with keys in the order given, short lists in one line, and a text of several lines as these lines."""
    import yaml  # the mathematics needs NumPy and SciPy only

    class Dumper(getattr(yaml, "CSafeDumper", yaml.SafeDumper)):  # type: ignore[misc]
        """Ten times as quick, where PyYAML has it in C."""

    Dumper.add_representer(
        str, lambda to, text: to.represent_scalar("tag:yaml.org,2002:str", text, style="|" if "\n" in text else None)
    )
    return str(yaml.dump(data, Dumper=Dumper, sort_keys=False, default_flow_style=None, width=160, allow_unicode=True))


_EXPONENT = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+\Z")


def read_yaml(path: Path) -> Any:
    """The data of a YAML file; raises BadTable with the place of the mistake."""
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise BadTable(str(path), f"is larger than {_MAX_BYTES >> 20} MiB", "give a YAML file")
        return parse_yaml(path.read_text(encoding="utf-8"), str(path))
    except UnicodeDecodeError as error:
        raise BadTable(str(path), "is not UTF-8 text", "give a YAML file") from error


def parse_yaml(text: str, source: str) -> Any:
    """The data of a YAML text; raises BadTable with the source and the place of the mistake."""
    import yaml  # the mathematics needs NumPy and SciPy only

    class Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
        """Reads 2e-05, which YAML 1.1 takes for a text, as a number."""

    Loader.add_implicit_resolver("tag:yaml.org,2002:float", _EXPONENT, list("-+.0123456789"))
    loader = Loader
    try:
        # the quick loader goes down as deep as a text does, and takes the process with it
        depth = 0
        for event in yaml.parse(text, Loader=loader):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > _MAX_DEPTH:
                raise BadTable(source, f"is nested more than {_MAX_DEPTH} levels deep", "correct it")
        return yaml.load(text, Loader=loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f" at line {mark.line + 1}" if mark is not None else ""
        raise BadTable(source, f"is not YAML{where}", "correct it") from error
    except (ValueError, TypeError, OverflowError, AttributeError, RecursionError, UnicodeError) as error:
        # of dates that are none, numbers of thousands of digits, and what else a loader does not expect
        raise BadTable(source, f"holds a value that cannot be read ({type(error).__name__})", "correct it") from error
