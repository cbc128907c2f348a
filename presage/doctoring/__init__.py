"""What `presage doctor` looks at: the installation, this machine, the bus; and what it makes of it."""
