"""What the training views observe: images over time, points looked up in them, what moves."""
