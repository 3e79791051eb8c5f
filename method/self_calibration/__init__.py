"""Self-calibration of an array from a clip: clocks that differ, and poses that are a degree off."""
