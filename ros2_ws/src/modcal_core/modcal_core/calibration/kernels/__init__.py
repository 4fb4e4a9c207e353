"""Quick ways to what the plain modules beside this room compute; tests hold each to its plain version."""
