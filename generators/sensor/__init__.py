"""The spike camera: simulator, fixed-pattern maps, calibration recordings."""
