"""The motion part of a recipe: how Gaussians move."""
