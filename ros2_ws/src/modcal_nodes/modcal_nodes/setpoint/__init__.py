"""What the setpoint node is made of."""
