"""Many recordings: calibrated on all cores or on a cluster, and put in one table."""
