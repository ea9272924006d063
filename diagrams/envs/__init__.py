"""Gymnasium environments built from task, guidance and station."""
