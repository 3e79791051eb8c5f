"""Tensors in files: models and network weights."""
