"""Stored results: tables of finished studies, numbers of reproduced figures, and the pages written from them."""
