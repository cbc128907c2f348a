"""Computes the data of the page from messages."""
