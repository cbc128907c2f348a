"""The mobile base and its laser scanner as data."""
