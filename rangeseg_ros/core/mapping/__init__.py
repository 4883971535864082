"""The world: transforms between frames, the map of planes, the motion of the camera."""
