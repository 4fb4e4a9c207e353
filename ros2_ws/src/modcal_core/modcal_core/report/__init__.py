"""Output for people and programs: JSON, pictures, pages."""
