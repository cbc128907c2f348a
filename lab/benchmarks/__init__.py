"""Latency, load and memory of the real processes."""
