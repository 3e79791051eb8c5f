"""The CPU kernels of the rasteriser, and how they are compiled and run."""
