"""The tables of README and the pages in docs/."""
