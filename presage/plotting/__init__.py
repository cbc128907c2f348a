"""Matplotlib style and map drawing."""
