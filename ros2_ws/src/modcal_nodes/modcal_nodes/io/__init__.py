"""Files in and out: calibrations, cells, reports, results."""
