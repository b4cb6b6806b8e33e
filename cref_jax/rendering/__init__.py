"""Pictures and films of the robot on its terrain."""
