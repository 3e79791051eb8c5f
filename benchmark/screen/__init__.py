"""What people see of long work and of objects, in a terminal and in a notebook: bars, and cards with thumbnails."""
