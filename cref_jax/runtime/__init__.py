"""The policy on the robot, with numpy alone; the export joins these files into cref_runtime.py."""
