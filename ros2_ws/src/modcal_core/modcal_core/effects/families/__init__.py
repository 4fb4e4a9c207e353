"""The families of effects, one a file: each names its candidates, what is plainer, its sizes and its sentence.

A file put here is found by itself. :data:`ORDER` is the order of the scan, which decides between candidates that
explain exactly as much; files that it does not list come behind, by name.
"""

ORDER = (
    *("compliance", "payload", "gear_ratio", "gear_harmonic", "backlash", "hysteresis", "coupling"),
    *("axis_wobble", "thermal", "drift", "step", "latency", "joint_lag", "scale", "outliers", "unknown", "residual"),
)
