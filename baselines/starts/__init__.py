"""The initialisation part of a recipe: camera poses and first points."""
