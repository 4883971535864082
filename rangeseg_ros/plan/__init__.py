"""Floor plans from maps of planes: what is level, upright and square, walls, openings, stairs."""
