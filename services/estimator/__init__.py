"""Scans in, beliefs out."""
