"""How the controller chooses a velocity."""
