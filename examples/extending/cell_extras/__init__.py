"""What one cell has that modcal does not know. A file each; pyproject.toml registers them."""
