"""Closed loop: commands to a drive, and the controller that decides them from poses. No ROS here."""
