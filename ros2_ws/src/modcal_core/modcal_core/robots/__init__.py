"""Robots: the serial chain, and the formats it is read from and written to."""
