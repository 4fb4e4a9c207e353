"""Quick ways to what the plain modules of calibration compute; tests hold each to its plain version."""
