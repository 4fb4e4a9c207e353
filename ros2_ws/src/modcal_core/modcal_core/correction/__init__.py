"""Where the arm truly is, and what to command so that it truly comes to be where it is wanted."""
