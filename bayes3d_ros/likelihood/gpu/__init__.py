"""Hypotheses rendered and scored by a Triton kernel."""
