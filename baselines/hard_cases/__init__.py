"""Hard cases of the baselines: images from spikes, whole fits, the array's clocks."""
