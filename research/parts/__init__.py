"""Benchmark of `create-task` on parts drawn by others: preparation, insertion, baselines and learning."""
