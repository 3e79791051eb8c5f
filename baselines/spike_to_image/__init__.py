"""The image part of a recipe: from spikes to images."""
