"""Studies: methods × seeds, run in parallel and evaluated on held-out episodes."""
