"""Views of fitted models: camera paths, videos, the viewer, and the speed of rendering."""
