"""Rigid-body geometry on plain arrays, batched over any leading axes."""
