"""What the page shows, computed from messages."""
