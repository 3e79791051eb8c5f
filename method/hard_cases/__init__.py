"""Hard cases of the method: the rasteriser, losses, motions, fits that stop and go on, and saved models."""
