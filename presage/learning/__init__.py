"""Trains models and builds maps."""
