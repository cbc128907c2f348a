"""Faults in a running system."""
