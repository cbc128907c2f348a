"""Learns and calibrates the distance field."""
