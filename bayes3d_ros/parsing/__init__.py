"""From one depth frame to a posterior over scenes. `parser.py` is the way in."""
