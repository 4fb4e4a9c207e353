"""What is said to people and programs: JSON, pictures, a page."""
