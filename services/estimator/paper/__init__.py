"""Preset `paper`: the estimator of Burghardt & Lanillos (2021)."""
