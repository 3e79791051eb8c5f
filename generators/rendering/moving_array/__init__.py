"""Rendering for an array that moves."""
