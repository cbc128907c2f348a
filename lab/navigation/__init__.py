"""Navigation around walls, furniture and people."""
