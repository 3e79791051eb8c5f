"""Measurements of this room for `report speed-error`: each approximation beside its exact twin."""
