"""Images and videos of the robot on its terrain."""
