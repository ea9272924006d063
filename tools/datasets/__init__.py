"""Demonstration files: formats, conversion, validation and bounds."""
