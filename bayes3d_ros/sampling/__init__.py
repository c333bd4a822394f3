"""Sequential Monte Carlo in general: nothing here knows what an object is."""
