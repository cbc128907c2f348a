"""Commands on the bus of a running session."""
