"""Problems small enough for exact answers, and the exact answers."""
