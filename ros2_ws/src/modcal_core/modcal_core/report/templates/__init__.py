"""Templates, style and scripts of the pages; package data."""
