"""What planes mean to a robot."""
