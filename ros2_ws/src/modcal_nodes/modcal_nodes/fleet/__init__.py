"""Many recordings: calibrated on all cores or on a cluster, put in one table, and compared over time."""
