"""The only package that uses zenoh."""
