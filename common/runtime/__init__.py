"""The service loop, and the settings, safety limits, health and metrics of every service."""
