"""Ends of a command other than success: an exit code, what happened in one line, and what to do next."""


class FogspecError(Exception):
    """Ends the command with `exit_code`; `message` is one line, `hints` are lines under it."""

    exit_code = 1

    def __init__(self, message: str, *hints: str) -> None:
        super().__init__(message)
        self.message = message
        self.hints = hints

    def __reduce__(self) -> tuple[object, ...]:
        """Let it pass between processes."""
        return _again, (type(self), self.message, self.hints)


def _again(kind: type[FogspecError], message: str, hints: tuple[str, ...]) -> FogspecError:
    """Return an error of another process."""
    found = kind.__new__(kind)
    FogspecError.__init__(found, message, *hints)
    return found


class InvalidInput(FogspecError):
    """A file is wrong and has no better place than its name."""

    exit_code = 1


class UsageError(FogspecError):
    """The command line is wrong."""

    exit_code = 2


class OutOfDate(FogspecError):
    """Something is stale, edited or drifted."""

    exit_code = 3


class Busy(FogspecError):
    """Another command works on this application: wait for it and run this one again."""

    exit_code = 8


class Infeasible(FogspecError):
    """No configuration meets the constraints: an answer, not a crash."""

    exit_code = 4


class Refused(FogspecError):
    """Over the budget, no confirmation, or not what was approved."""

    exit_code = 5


class CloudError(FogspecError):
    """Quota, capacity, network: safe to run again."""

    exit_code = 6


class NotMeasured(FogspecError):
    """Too little was measured for a manifest: nothing that counts, not all of the plan, or one more sample may decide."""

    exit_code = 7


class NotInstalled(CloudError):
    """A program or package that the command needs is not installed here."""

    exit_code = 2


class Interrupted(FogspecError):
    """The user stopped it: safe to run again."""

    exit_code = 130
