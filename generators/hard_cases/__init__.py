"""Hard cases of the generators: the spike sensor, events, emulated cameras."""
