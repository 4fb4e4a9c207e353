"""What was measured: the recording, the stations cut from it, and the samples a fit sees."""
