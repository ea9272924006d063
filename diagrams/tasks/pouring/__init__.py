"""The task Pouring."""
