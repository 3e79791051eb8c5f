"""Training of the image network on rendered bursts."""
