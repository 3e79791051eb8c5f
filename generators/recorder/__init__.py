"""The recorder: an array of spike cameras over USB, written as a scene folder."""
