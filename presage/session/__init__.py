"""Runs a whole system on this machine."""
