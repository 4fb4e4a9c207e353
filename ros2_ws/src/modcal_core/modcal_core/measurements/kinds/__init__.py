"""Kinds of reading: one file each, registered in :mod:`registry`."""
