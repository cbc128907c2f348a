"""Summaries, figures and exports of recordings."""
