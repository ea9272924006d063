"""Stored results: the tables of finished studies and the numbers of reproduced figures, and the pages written of them."""
