"""Parts shared by several worlds: the street and its vehicles, the desk, the garden, the human figure, the bird."""
