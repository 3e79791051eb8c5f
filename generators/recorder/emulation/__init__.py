"""An array of cameras in software, behind a pyusb backend."""
