"""The commands that work on a study; with `adaptune.cli`, the only code that sees both stages."""
