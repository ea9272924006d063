"""The task BncConnector."""
