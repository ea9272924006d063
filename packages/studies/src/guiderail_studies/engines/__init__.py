"""Engines that run the jobs of a study, one module each."""
