"""Pictures, pages and videos of episodes, runs and studies."""
