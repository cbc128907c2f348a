"""What every service process needs besides its algorithm."""
