"""Measuring until a wanted accuracy is proven: which station comes next, and when there are enough."""
