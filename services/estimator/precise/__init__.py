"""Preset `precise`: a learned distance field and hypotheses with covariance."""
