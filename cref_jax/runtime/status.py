"""What is wrong with the inputs of a step or a frame."""

import enum


class Status(enum.IntFlag):
    """Faults of a step or a frame; 0 means none."""

    OK = 0
    NO_DEPTH = 1  # no frame has come since the reset
    STALE_DEPTH = 2  # the newest frame is older than the manifest allows
    BAD_DEPTH = 4  # the frame's shape, type or stamp is wrong: not used
    INVALID_DEPTH = 8  # too many of the frame's pixels are holes: not used
    BAD_INPUT = 16  # wrong shape, not finite, or impossible: the network was not run
    BAD_ACTION = 32  # the network's output was not finite
    COMMAND_LIMITED = 64  # the command was outside the trained range and was clipped
    RATE_LIMITED = 128  # the change of the target in this step was limited
    RANGE_LIMITED = 256  # the target was too far beyond a joint's range and was clipped
    LATE = 512  # the previous step is too long ago, or the clock went back
    HOLDING = 1024  # the last good target was returned again
    DAMPING = 2048  # the target is the measured pose, until `reset`


FAULTS = Status.BAD_INPUT | Status.BAD_ACTION
