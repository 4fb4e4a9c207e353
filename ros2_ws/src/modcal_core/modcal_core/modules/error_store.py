"""What is known of modules as plain data: for people and for the next assembly, and enough to learn on from.

``modules`` is what assembling reads: mean and covariance of every part of every physical module. ``assemblies`` is what
it was learned from; learning on reads these, and solves for all modules again.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from modcal_core.errors import BadTable, refusing
from modcal_core.geometry.so3 import Array
from modcal_core.modules.assembly import Assembly
from modcal_core.modules.errors import Key, ModuleErrors, learn
from modcal_core.modules.library import Library
from modcal_core.modules.recording_evidence import RecordingEvidence
from modcal_core.modules.spec import assembly_from_data, assembly_to_data

FORMAT = 1  # of the file
_FIX = "give a file that modcal modules learn wrote"


def store_to_data(known: ModuleErrors, library: Library) -> dict[str, Any]:
    """The store as nested dictionaries, lists, strings and floats; floats keep every digit."""
    modules: dict[str, dict[str, Any]] = {}
    for (serial, part), error in known.parts.items():
        entry = modules.setdefault(serial, {"kind": error.kind, "length": error.size, "parts": {}})
        entry["parts"][part] = {
            "assemblies": error.seen,
            "mean": _floats(error.twist),
            "std": _floats(error.std),
            "covariance": [_floats(row) for row in error.covariance],
        }
    return {
        "modcal_module_store": FORMAT,
        "library": library.name,
        "modules": modules,
        "assemblies": [_recording_to_data(w, library) for w in known.recordings],
    }


@refusing
def store_from_data(data: Any, library: Library, source: str) -> ModuleErrors:
    """The store, with everything learned again from its assemblies. Raises BadTable for what is no store."""
    if not isinstance(data, Mapping) or data.get("modcal_module_store") != FORMAT:
        raise BadTable(source, f"is not a store of modules (modcal_module_store: {FORMAT})", _FIX)
    if data.get("library") != library.name:
        said = f"its modules are of the library '{data.get('library')}', not of '{library.name}'"
        raise BadTable(source, said, "give --library")
    stated = data.get("assemblies")
    if not isinstance(stated, list):
        raise BadTable(f"{source}: assemblies", "is not a list", _FIX)
    return learn(
        [_recording_from_data(w, library, f"{source}: assembly {i + 1}") for i, w in enumerate(stated)], library
    )


@refusing
def twists_from_data(data: Any, source: str) -> dict[Key, Array]:
    """Means by (serial number, part) as the store states them. Raises BadTable for what is no store."""
    if not isinstance(data, Mapping) or data.get("modcal_module_store") != FORMAT:
        raise BadTable(source, f"is not a store of modules (modcal_module_store: {FORMAT})", _FIX)
    try:
        return {
            (str(serial), str(part)): _numbers(error["mean"], (6,), f"{source}: {serial}: {part}: mean")
            for serial, entry in data["modules"].items()
            for part, error in entry["parts"].items()
        }
    except (KeyError, TypeError, AttributeError) as error:
        raise BadTable(f"{source}: modules", f"is not a mapping of serial numbers ({error!r})", _FIX) from error


def with_recording(known: ModuleErrors, new: RecordingEvidence, library: Library) -> ModuleErrors:
    """What is known after one more assembly; one of the same name is replaced, for it is the same flanges seen again.

    Raises BadTable where an assembly of other modules has that name already.
    """
    for old in known.recordings:
        if old.assembly.name == new.assembly.name and old.assembly != new.assembly:
            said = "is a different assembly in this store"
            raise BadTable(
                f"assembly {new.assembly.name}", said, "give each assembly a name of its own, also when rebuilt"
            )
    kept = [w for w in known.recordings if w.assembly.name != new.assembly.name]
    return learn([*kept, new], library)


def _recording_to_data(w: RecordingEvidence, library: Library) -> dict[str, Any]:
    lower = np.tril_indices(len(w.information))
    spec = assembly_to_data(w.assembly, library)
    spec.pop("aim")
    return {
        **spec,
        "stations": w.stations,
        "residual_m": w.residual,
        "deviation": [_floats(row) for row in w.deviation],
        "information": _floats(w.information[lower]),
    }


def _recording_from_data(data: Any, library: Library, source: str) -> RecordingEvidence:
    if not isinstance(data, Mapping):
        raise BadTable(source, "is not a mapping", _FIX)
    own = ("stations", "residual_m", "deviation", "information")
    missing = [key for key in own if key not in data]
    if missing:
        raise BadTable(f"{source}: {missing[0]}", "is missing", _FIX)
    assembly: Assembly = assembly_from_data({k: v for k, v in data.items() if k not in own}, library, source)
    size = 6 * (assembly.n - 1)
    deviation = _numbers(data["deviation"], (assembly.n - 1, 6), f"{source}: deviation")
    lower = np.tril_indices(size)
    information = np.zeros((size, size))
    information[lower] = _numbers(data["information"], (len(lower[0]),), f"{source}: information")
    information += np.tril(information, -1).T
    stations, residual = (_numbers(data[key], (), f"{source}: {key}") for key in ("stations", "residual_m"))
    return RecordingEvidence(assembly, deviation, information, int(stations), float(residual))


def _numbers(stated: Any, shape: tuple[int, ...], what: str) -> Array:
    try:
        out = np.asarray(stated, dtype=float)
    except (TypeError, ValueError, OverflowError):
        out = np.empty(0)
    if out.shape != shape or not np.isfinite(out).all():
        raise BadTable(what, f"does not hold {' x '.join(map(str, shape)) or 'one'} finite numbers", _FIX)
    return out


def _floats(values: Array) -> list[float]:
    return [float(x) for x in values]
