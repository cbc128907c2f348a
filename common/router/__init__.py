"""The zenoh router as a process: `python -m common.router`."""
