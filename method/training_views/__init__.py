"""Observations of the training views: images over time, their values at points, and what changes in them."""
