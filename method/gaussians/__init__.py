"""Gaussians: parameters, density control, optimiser."""
