"""The commands of `presage`: they parse arguments and call the other packages."""
