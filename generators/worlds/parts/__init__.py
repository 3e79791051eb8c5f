"""Parts that worlds share, such as the street, the desk and the human figure."""
