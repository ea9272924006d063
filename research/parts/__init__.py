"""Benchmark of `create-task` on third-party meshes: preparation, insertion, baselines and learning."""
