"""Errors that a user can mend: the message is one line that says what would be right."""


class CheckpointError(RuntimeError):
    """A checkpoint that cannot be written or read; the message is one line that says which."""


class DamagedCheckpoint(CheckpointError):
    """The files of this step are not what was written; an older step may still be good."""


class TrainingError(RuntimeError):
    """Training cannot go on; the message is one line that says why."""


class ConfigError(ValueError):
    """A setting that cannot be used; the message is one line that says what would be right."""
