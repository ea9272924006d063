"""Wiring: stations, guidance, tasks, and the Gymnasium environments built from them."""
