"""The sheet of a scene, truth and methods side by side where things move, as a picture and as a video."""
