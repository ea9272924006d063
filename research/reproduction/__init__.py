"""Reproduction of the thesis's figures with its numbers of runs: runs, stored tables, and a report with verdicts."""
