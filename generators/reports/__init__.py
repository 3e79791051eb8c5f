"""Tables and pictures of scenes and of what their making costs."""
