"""Measuring on order: the folder that keeps a session, and those who measure for it."""
