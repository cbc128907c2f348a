"""Code that the services share. Imports no service."""
