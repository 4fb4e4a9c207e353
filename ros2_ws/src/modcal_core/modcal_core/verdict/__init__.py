"""What may be said of a calibration: at the floor, open, or cannot tell; and the account that the words rest on."""
