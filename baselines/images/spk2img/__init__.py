"""Spk2ImgNet: images from spikes by a trained network, its training, and its weights."""
