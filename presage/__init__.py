"""Laser-only localisation and navigation by predictive processing: the command line."""

__version__ = "0.1.0"
