"""Records all messages in MCAP files, and replays them."""
