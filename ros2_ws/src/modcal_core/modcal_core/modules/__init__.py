"""Modular arms: a library of modules, which of them are bolted together and how, and the arm that comes of it."""
