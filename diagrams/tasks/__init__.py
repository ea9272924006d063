"""Tasks, one folder each, and their registry."""
