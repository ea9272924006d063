"""Pictures, pages and videos of episodes and runs."""
