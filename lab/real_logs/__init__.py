"""Real logs: learn from one half, localise the other."""
