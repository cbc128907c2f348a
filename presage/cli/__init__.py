"""The commands: arguments in, calls to the packages below."""
