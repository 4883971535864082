"""Ground with all that stops a robot, as a depth camera on the robot sees it, and the truth."""
