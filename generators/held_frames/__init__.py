"""Scenes of what other people's cameras filmed: each instant held still in front of the simulated spike cameras."""
