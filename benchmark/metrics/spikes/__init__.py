"""Metrics that judge a prediction by the spikes that a held-out camera recorded itself."""
