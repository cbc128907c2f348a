"""Beliefs and goals in, velocity commands out."""
