"""Accuracy of the estimators against the Cramér-Rao bound."""
