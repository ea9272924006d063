"""Grid clamp and its table."""
