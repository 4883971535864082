"""ROS messages without ROS: for the node, for recordings, for readers of either."""
