"""A physical stand-in for a cell: MuJoCo computes where things are, not modcal's kinematics."""
