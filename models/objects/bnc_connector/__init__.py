"""BNC connector."""
