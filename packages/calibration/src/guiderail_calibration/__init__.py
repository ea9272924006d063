"""Calibration of a simulation to a robot by simulation-based inference, from recorded episodes."""
