"""Recordings of demonstrations: formats, conversion, validation and bounds."""
