"""Numerics of robots without Drake: status checks, message sequence and state estimation."""
