"""Exploration of unknown buildings, compared with a frontier explorer."""
