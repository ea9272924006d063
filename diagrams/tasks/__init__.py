"""Tasks: one folder each, with its options, rewards, workcell and scripted policies."""
