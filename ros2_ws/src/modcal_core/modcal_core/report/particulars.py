"""What a person states for a certificate; apart, so that reading a cell file loads no report."""

from __future__ import annotations

from dataclasses import dataclass

from modcal_core.errors import BadTable

MAX_TEXT = 90  # characters of a text that a person gives, so that the page stays one


@dataclass(frozen=True)
class Particulars:
    """What a person states for the certificate; empty texts are left open on the page.

    robot: name of the arm. serial: its serial number. instrument: make, model and serial number of the instrument, with
    its own certificate. conditions: payload, temperature, mounting. measured_by, approved_by: names. Raises BadTable
    for a text of more than 90 characters.
    """

    robot: str = ""
    serial: str = ""
    instrument: str = ""
    conditions: str = ""
    measured_by: str = ""
    approved_by: str = ""

    def __post_init__(self) -> None:
        for name, text in vars(self).items():
            if len(text) > MAX_TEXT:
                said = f"has {len(text)} characters, {MAX_TEXT} is the limit"
                raise BadTable(f"certificate: {name}", said, "shorten it")
