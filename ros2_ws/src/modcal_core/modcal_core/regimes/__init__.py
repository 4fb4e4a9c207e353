"""Stretches of a recording in which base or tool stood elsewhere."""
