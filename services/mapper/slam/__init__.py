"""Builds maps from scans: simultaneous localisation and mapping, without a bus or files."""
