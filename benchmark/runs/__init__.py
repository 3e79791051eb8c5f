"""Running methods on scenes: cells, displays, executors, the command `run-benchmark`."""
