"""Image makers: the image part of a recipe, from spikes to images."""
