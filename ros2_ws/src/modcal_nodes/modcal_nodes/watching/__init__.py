"""Parts of ``modcal watch``: what it has received, what it listens to, and how that is shown."""
