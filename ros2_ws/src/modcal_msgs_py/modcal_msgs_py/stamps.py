"""Stamps and durations of messages as seconds, and back."""

from __future__ import annotations

from typing import Any


def seconds(stamp: Any) -> float:
    """A builtin_interfaces/Time or Duration in seconds."""
    return float(stamp.sec + 1e-9 * stamp.nanosec)


def set_seconds(stamp: Any, value: float) -> None:
    """Write seconds into a builtin_interfaces/Time or Duration, to the nanosecond."""
    nanoseconds = round(value * 1e9)
    stamp.sec, stamp.nanosec = nanoseconds // 10**9, nanoseconds % 10**9
