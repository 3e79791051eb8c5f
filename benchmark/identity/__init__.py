"""The identity of a scene: verification of its content, and copies of fewer bytes and the same revision."""
