"""Where the arm is wrong: places and directions of error, the fit, what the data can tell, the score."""
