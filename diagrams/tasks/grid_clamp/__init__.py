"""The task GridClamp."""
