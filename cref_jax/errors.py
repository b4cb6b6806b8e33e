"""Errors that a user can fix; each message is one line."""


class CheckpointError(RuntimeError):
    """A checkpoint cannot be written or read; the message is one line that names it."""


class DamagedCheckpoint(CheckpointError):
    """The files of this step differ from those written; an older step may still be good."""


class TrainingError(RuntimeError):
    """Training cannot continue; the message is one line with the reason."""


class ConfigError(ValueError):
    """A setting cannot be used; the message is one line that states what is expected."""
