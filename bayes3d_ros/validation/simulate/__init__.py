"""Depth recordings of simulated scenes; shares no renderer and no noise model with the likelihood."""
