"""The MCAP files of a recording."""
