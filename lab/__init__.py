"""Experiments, benchmarks and fault injection."""
