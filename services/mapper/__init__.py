"""Maps while driving: scans in, map and belief out."""
