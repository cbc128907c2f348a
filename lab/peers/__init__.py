"""presage on the scans on which other programs were measured."""
