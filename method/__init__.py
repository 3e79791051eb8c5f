"""Spike4DGS: rasteriser back ends, Gaussians, deformation and the shared trainer."""
