"""Tasks, one file each, and their registry."""
