"""Plays a recording."""
