"""The supervision part of a recipe: what is compared with what."""
