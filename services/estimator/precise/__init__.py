"""Preset `precise`: a learned distance field and inference at the limit of the sensor."""
