"""What ``modcal watch`` is made of: what it has heard of a cell, what it listens to, and how that is shown."""
