"""Export of skills to C++."""
