"""SpikeNeRF with the deformation of 4DGS (Dy-SpikeNeRF): a radiance field fitted to spikes by ray marching."""
