"""The methods of `methods.json`, by name: the call, whose version is told, which environment, and a sentence."""

import json
from pathlib import Path

_TOLD = json.loads((Path(__file__).resolve().parents[1] / "methods.json").read_text())
METHODS: dict[str, dict[str, str]] = _TOLD["methods"]
MISSING: dict[str, str] = _TOLD["missing"]  # what was looked for and is not here, with the reason
