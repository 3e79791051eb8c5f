"""Looking at fitted models: camera paths, videos, the viewer, and how fast a model renders."""
