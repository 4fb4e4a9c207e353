"""``--certificate``: one page to sign, beside the report of a calibration or an evaluation."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from modcal_core.errors import BadTable
from modcal_core.report import Particulars
from modcal_nodes.io import read_particulars

if TYPE_CHECKING:
    from modcal_core.report import Hashes
    from modcal_core.verdict import Tolerance
    from modcal_nodes.cli.calibrate import CertifiedOptions

UNMET = 3  # exit code: done, but the tolerance is not met or cannot be told


def particulars(options: CertifiedOptions) -> Particulars | None:
    """What is stated for a certificate, before anything is computed; None if none was asked for. Raises BadTable."""
    if not options.certificate:
        if options.serial is not None:
            raise BadTable("--serial", "is printed on a certificate only", "add --certificate")
        return None
    if options.tolerance_mm is None:
        raise BadTable("--certificate", "has no tolerance to judge by", "give --tolerance-mm, e.g. --tolerance-mm 0.2")
    said = read_particulars(options.cell_file)
    return said if options.serial is None else replace(said, serial=options.serial)


def exit_code(met: Tolerance | None) -> int:
    """0 where no tolerance was asked for, or it is met."""
    return 0 if met is None or met.result == "PASS" else UNMET


def certified_hashes(
    description: str | Path | None, calibration: str | Path, images: Sequence[Path | None] = ()
) -> Hashes:
    """SHA-256 of a robot description and a calibration, each a text, or a file (of a folder its calibration.yaml).

    images: folders and files that a calibration by camera was made from; of all of them one, as of a bag of many files.
    """
    from modcal_core.report import Hashes

    if isinstance(calibration, Path) and calibration.is_dir():
        calibration = calibration / "calibration.yaml"
    files = [file for one in images if one is not None for file in (sorted(one.iterdir()) if one.is_dir() else [one])]
    listed = "".join(f"{_digest(file)}  {file.name}\n" for file in files if file.is_file())
    return Hashes(
        recording=_digest(listed) if listed else None,
        description=None if description is None else _digest(description),
        calibration=_digest(calibration),
    )


def _digest(content: str | Path) -> str:
    return hashlib.sha256(content.read_bytes() if isinstance(content, Path) else content.encode()).hexdigest()
