"""The commands: the only code that sees both stages."""
