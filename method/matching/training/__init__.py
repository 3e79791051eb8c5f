"""Training of the matching network on exact correspondences."""
