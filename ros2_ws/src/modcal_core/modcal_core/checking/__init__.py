"""What has changed since a calibration, told from a few stations."""
