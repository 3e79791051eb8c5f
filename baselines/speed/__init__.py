"""Speed measurements of `spike4dgs speed`: images from spikes beside plain numpy and other programs, with the error."""
