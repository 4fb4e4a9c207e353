"""A camera and a printed sheet as the instrument: targets, lens, where camera and sheet are, and one fit of it all."""
