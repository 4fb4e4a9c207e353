"""Images: finding the printed target in them, reading folders of them, and drawing the sheet to print."""
