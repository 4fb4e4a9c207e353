"""Articulated objects: how a handle moves, learned from poses or points of it, and told from what else it could be."""
