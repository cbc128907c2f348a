"""The policies that choose the velocity."""
