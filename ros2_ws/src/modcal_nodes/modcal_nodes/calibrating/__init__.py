"""What the calibrator node is made of: what it remembers, solves, keeps and says."""
