"""Dynamic 3D Gaussians: the motion `tracking`, with a loop of its own."""
