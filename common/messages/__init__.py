"""Every message, the table of topics, and the wire format."""
