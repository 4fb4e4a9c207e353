"""Thin nodes around modcal_core, and the modcal command."""
