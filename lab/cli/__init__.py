"""The commands `presage bench` and `presage experiment`."""
