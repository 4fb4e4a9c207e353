"""What the model lacks: where the residual sits, in which direction, and on what it depends."""
