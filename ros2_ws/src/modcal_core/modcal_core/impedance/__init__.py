"""Touching gently: the impedance law, the guard before every setpoint, and the course of pulling something open."""
