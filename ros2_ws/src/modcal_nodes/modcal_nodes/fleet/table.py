"""The tables of a fleet as Parquet files, with the same columns and types whatever is in them."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

_TEXT, _NUMBER = pa.string(), pa.float64()
_PARAMETER = pa.struct([("name", _TEXT), ("value", _NUMBER), ("std", _NUMBER), ("unit", _TEXT)])
_SIZES = tuple(f"{stage}_{size}_mm" for stage in ("nominal", "geometric", "final") for size in ("rms", "p95"))
_TIME = pa.timestamp("ms", tz="UTC")

FLEET = pa.schema(
    [
        *((name, _TEXT) for name in ("name", "robot", "model", "kinematics", "state", "said")),
        ("started", _TIME),
        *(("duration_s", _NUMBER), ("measurement", _TEXT), ("stations", pa.int64()), ("rejected", pa.int64())),
        *((name, _NUMBER) for name in (*_SIZES, "floor_mm", "unexplained_mm")),
        *(("effects", pa.list_(_TEXT)), ("parameters", pa.list_(_PARAMETER))),
        *(("rank", pa.int64()), ("condition", _NUMBER), ("verdict", _TEXT)),
        *(("status", _TEXT), ("open_because", pa.list_(_TEXT))),
        *((name, _NUMBER) for name in ("frozen_rms_mm", "frozen_p95_mm")),
        *((name, _TEXT) for name in ("compared", "drift", "bag")),
        ("took_s", _NUMBER),
    ]
)
DRIFT = pa.schema(
    [
        *(("robot", _TEXT), ("kinematics", _TEXT), ("since", _TIME), ("until", _TIME), ("recordings", pa.int64())),
        *(("parameter", _TEXT), ("named", pa.bool_()), ("unit", _TEXT)),
        *((name, _NUMBER) for name in ("change", "change_std", "per_week", "per_week_std", "p_value")),
    ]
)


def write_table(path: Path, rows: Sequence[dict[str, Any]], schema: pa.Schema) -> None:
    """Write rows under these columns; what a row does not have is null. On failure what stood there stays."""
    columns = [
        pa.array([row.get(field.name) for row in rows], _TEXT).cast(field.type)
        if pa.types.is_timestamp(field.type)
        else pa.array([row.get(field.name) for row in rows], field.type)
        for field in schema
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.part")
    try:
        pq.write_table(pa.table(columns, schema=schema), part, compression="zstd")
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)
