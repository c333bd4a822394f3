"""Hypotheses rendered and scored by loops that numba compiles."""
