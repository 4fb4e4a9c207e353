"""The modcal command: one file per verb, gathered in main."""
