"""Recorded data through services and estimators again."""
