"""The `guiderail` command."""
