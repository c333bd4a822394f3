"""What the world is: objects, scenes, how they render, how likely an image is."""
