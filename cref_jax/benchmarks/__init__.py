"""Speed and memory, compared with peers and hardware bounds."""
