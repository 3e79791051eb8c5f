"""Tables and images of scenes and of the cost of making them."""
