"""Calibration that goes on while the arm works: samples as they come, a running estimate, and what has changed."""
