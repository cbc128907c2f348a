"""Every message into MCAP, and back onto the bus."""
