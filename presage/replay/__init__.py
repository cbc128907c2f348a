"""Runs services and estimators on recorded data again."""
