"""An array of emulated cameras behind a pyusb backend."""
