"""Reports as HTML pages: one file each, with nothing from a network, in light and dark, on a desk and on a phone."""
