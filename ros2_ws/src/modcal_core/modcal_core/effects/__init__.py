"""Errors as small motions at places: what an effect is, what drives it, and the families that effects come in."""
