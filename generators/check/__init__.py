"""`make-dataset --check`: whether two scenes are the same data, the same world under other noise, or two worlds."""
