"""How far a skill reaches: what a policy comes to where something is other than where it learned."""
