"""``--certificate``: one page to sign, beside the report of a calibration or an evaluation."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from modcal_core.calibration import Cell, Stated
from modcal_core.errors import BadTable
from modcal_core.report import Particulars
from modcal_nodes.cli.console import UNMET
from modcal_nodes.io import FrozenOptions, option, read_cell, read_particulars, stated_from

if TYPE_CHECKING:
    from modcal_core.measurements import Samples
    from modcal_core.outcome import Outcome
    from modcal_core.report import Hashes
    from modcal_core.verdict import Tolerance


@dataclass(frozen=True)
class CertifiedOptions(FrozenOptions):
    """The same with what is asked of a certificate."""

    certificate: bool = option("Write certificate.html, a page to print and sign. Needs --tolerance-mm.", default=False)
    serial: str | None = option("Serial number of the robot, for the certificate.", metavar="TEXT")

    @property
    def cell(self) -> Cell:
        """What is known of the surroundings of a frozen calibration."""
        return read_cell(self.cell_file, stated=stated_from(vars(self)))

    def particulars(self) -> Particulars | None:
        """What is stated for a certificate; None if none was asked for. Raises BadTable."""
        if not self.certificate:
            if self.serial is not None:
                raise BadTable("--serial", "is printed on a certificate only", "add --certificate")
            return None
        if self.tolerance_mm is None:
            raise BadTable("--certificate", "has no tolerance to judge by", "give --tolerance-mm, such as 0.2")
        said = read_particulars(self.cell_file)
        return said if self.serial is None else replace(said, serial=self.serial)

    def certified(
        self, report: Outcome, samples: Samples, description: str | Path | None, calibration: str | Path
    ) -> dict[str, str]:
        """Name and text of the certificate's file; none where none was asked for.

        description, calibration: of :func:`certified_hashes`.
        """
        if (said := self.particulars()) is None:
            return {}
        from modcal_core.report import certificate

        # options go before the cell file, and that before what instruments state
        own = Stated(instrument_mm=samples.origin.instrument_mm, instrument_deg=samples.origin.instrument_deg)
        hashes = certified_hashes(description, calibration)
        return {"certificate.html": certificate(report, self.cell.stated.over(own), said, hashes).html()}


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
