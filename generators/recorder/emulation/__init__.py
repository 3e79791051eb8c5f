"""An array of emulated cameras as devices on a bus."""
