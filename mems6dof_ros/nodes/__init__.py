"""The ROS shell: thin nodes around the pure core."""
