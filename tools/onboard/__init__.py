"""`guiderail onboard`: from two mesh files to a task."""
