"""Hard inputs and what must come out of them: the cases of `report hard-cases`, and their runner."""
