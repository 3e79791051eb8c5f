"""Tables and images of scenes and of what their making costs."""
