"""Entry points that only containers use."""
