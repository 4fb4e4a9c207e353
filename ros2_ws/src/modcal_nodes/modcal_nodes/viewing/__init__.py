"""What the viewer node is made of: the stations it keeps and the pictures it draws."""
