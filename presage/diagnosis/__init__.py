"""Finds problems of the installation and of a running session."""
