"""The scene folder: reading, writing, cameras, splits, calibration, and exchange with other formats."""
