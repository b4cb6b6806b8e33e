"""What is wrong with the inputs of a step or a frame, as flags and in words."""

import enum


class Status(enum.IntFlag):
    """Faults of a step or a frame; 0 means none."""

    OK = 0
    NO_DEPTH = 1  # no usable frame has come since the reset
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
    NOT_STARTED = 1 << 12  # something is not right yet: the target is the pose measured first
    STARTING = 1 << 13  # the target moves from the measured pose to the default one
    STOPPED = 1 << 14  # the command is taken as zero
    GRAVITY_TURNED = 1 << 15  # gravity is far from the base's -z: the network was not run
    GYRO_TOO_FAST = 1 << 16  # no robot that walks turns so fast; done without in this step
    JOINTS_TOO_FAST = 1 << 17  # no joint of one that walks is so fast; likewise
    NOT_ON_FEET = 1 << 18  # at the start, the feet are not level by gravity and joint angles
    GYRO_WRONG = 1 << 19  # it does not turn as gravity does; done without, and STOPPED
    GRAVITY_WRONG = 1 << 20  # it does not turn as the gyro does; done without, and STOPPED
    IMU_TURNED = 1 << 21  # the base rolls the other way by the legs; turned back, and STOPPED
    JOINT_SPEEDS_WRONG = 1 << 22  # they are not the angles' changes; done without, and STOPPED
    JOINTS_MIXED_UP = 1 << 23  # joints move against their targets; STOPPED
    SEES_NOTHING = 1 << 24  # hardly a pixel is nearer than d_max: the frame was not used
    SEES_TOO_NEAR = 1 << 25  # the ground is nearer than the robot's legs are long: not used
    CAMERA_TURNED = 1 << 26  # the frame's upper part is nearer than its lower: not used
    CAMERA_MIRRORED = 1 << 27  # the ground tilts the other way: turned back, and STOPPED
    FROZEN_DEPTH = 1 << 28  # the same frame again and again: not used
    STALE_COMMAND = 1 << 29  # the command is too old; STOPPED


FAULTS = Status.BAD_INPUT | Status.BAD_ACTION | Status.GRAVITY_TURNED | Status.NOT_ON_FEET
TOO_FAST = Status.GYRO_TOO_FAST | Status.JOINTS_TOO_FAST
SENSES_WRONG = (
    Status.GYRO_WRONG
    | Status.GRAVITY_WRONG
    | Status.IMU_TURNED
    | Status.JOINT_SPEEDS_WRONG
    | Status.JOINTS_MIXED_UP
)
STOPPING = SENSES_WRONG | Status.CAMERA_MIRRORED
UNUSED_FRAME = (
    Status.BAD_DEPTH
    | Status.INVALID_DEPTH
    | Status.SEES_NOTHING
    | Status.SEES_TOO_NEAR
    | Status.CAMERA_TURNED
    | Status.FROZEN_DEPTH
)

WHY = {
    Status.NO_DEPTH: "no usable frame has come since the reset: the pose measured first is held",
    Status.STALE_DEPTH: "the newest usable frame is too old, or its stamp is of another clock",
    Status.BAD_DEPTH: "a frame cannot be read",
    Status.INVALID_DEPTH: "too many pixels of a frame are 0 or NaN",
    Status.BAD_INPUT: "an input cannot be used",
    Status.BAD_ACTION: "the network's answer is not finite: an input is far from all training",
    Status.COMMAND_LIMITED: "the command is outside the trained range and was clipped",
    Status.RATE_LIMITED: "a target moved further than its motor can turn the joint in a step",
    Status.RANGE_LIMITED: "a target is so far beyond its joint's range that the motor has no more "
    "torque for it",
    Status.LATE: "steps do not come at the control rate, or `now` is not in seconds",
    Status.HOLDING: "the last good target is held",
    Status.DAMPING: "the target is the measured pose until reset(): only damping acts",
    Status.NOT_STARTED: "not started yet: the pose measured first is held",
    Status.STARTING: "the target moves from the measured pose to the default one",
    Status.STOPPED: "the command is taken as zero: the robot stands",
    Status.GRAVITY_TURNED: "gravity must be near (0, 0, -1) when the robot is upright: it has "
    "fallen, or a sign (an accelerometer at rest shows the opposite), axis or frame is wrong",
    Status.GYRO_TOO_FAST: "angular velocity is beyond what a robot does: deg/s in place of rad/s?",
    Status.JOINTS_TOO_FAST: "joint speeds are beyond what a robot does: deg/s in place of rad/s?",
    Status.NOT_ON_FEET: "by the joint angles the feet are not level: stand the robot on both feet, "
    "and check order, signs and zeros of the joints and the frame of gravity",
    Status.GYRO_WRONG: "gravity does not turn as angular velocity says: a sign, an axis or the "
    "unit of angular velocity is wrong",
    Status.GRAVITY_WRONG: "gravity does not turn as angular velocity says: a sign or an axis of "
    "gravity is wrong",
    Status.IMU_TURNED: "the base rolls the other way than the legs: gravity and angular velocity "
    "are given in the frame of an IMU that is mounted turned",
    Status.JOINT_SPEEDS_WRONG: "joint angles do not change as qd says: a sign or the order of qd "
    "is wrong",
    Status.JOINTS_MIXED_UP: "joints move against their targets: two are exchanged, or a sign is "
    "wrong",
    Status.SEES_NOTHING: "hardly a pixel is nearer than d_max: the camera is covered or looks "
    "away, or its raw unit is smaller than taken (load(..., depth_scale=1e-4) for 0.1 mm)",
    Status.SEES_TOO_NEAR: "the ground seems nearer than the legs are long: something covers the "
    "camera, or the frame's unit is larger than taken",
    Status.CAMERA_TURNED: "the ground is nearer at the frame's top than at its bottom: the camera, "
    "or the order of its rows, is upside down",
    Status.CAMERA_MIRRORED: "the ground in the frame tilts to the other side than the robot: the "
    "order of the frame's columns is wrong",
    Status.FROZEN_DEPTH: "the camera sends the same frame again and again",
    Status.STALE_COMMAND: "the command is too old",
}
