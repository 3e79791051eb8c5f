"""The CUDA kernels of the rasteriser, compiled by numba-cuda without a toolkit, and the torch code around them."""
