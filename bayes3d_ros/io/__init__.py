"""Recordings, result files and pictures."""
