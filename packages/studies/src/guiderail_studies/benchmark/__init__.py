"""Benchmark of methods on tasks with contact: protocol, runs, submissions, verification and the page of results."""
