"""Errors of the service, subclasses of `hal.errors.CellError`."""

from __future__ import annotations

import errno

from hal.errors import CellError, DeviceUnavailable, InvalidRequest, LeaseError, Retry

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)


class Busy(CellError):
    """A queue is full, so the request was not accepted."""

    retry = Retry.SAFE


class NoSuchTask(InvalidRequest):
    """There is no task or artefact with that name."""


class NoSuchMission(NoSuchTask):
    """There is no file of a mission with that name."""


class NoSuchDevice(NoSuchTask):
    """The cell file has no device of that name."""


class DevicesUnavailable(DeviceUnavailable):
    """Several devices did not connect; the details give cause and remedy for each."""

    retry = Retry.AFTER_FIX


class NotConnected(DeviceUnavailable):
    """The device did not connect, neither at the cell's start nor later; the rest of the cell works."""

    retry = Retry.AFTER_FIX


class NotPossibleNow(CellError):
    """The requested object exists, but its state does not allow the request."""

    retry = Retry.AFTER_FIX


class StaleEpoch(LeaseError):
    """The lease that came with the command is not valid any more."""


class StaleSequence(LeaseError):
    """A command has a number that is not greater than that of an earlier one, or none although the others have."""


class Expired(LeaseError):
    """The time until which a command could begin has passed; nothing moved."""


class TooDistant(LeaseError):
    """The time until which a command may begin is too far away; nothing moved."""


class Aborted(CellError):
    """The service ended while the task ran; the arm was stopped. The task was not taken up again."""

    retry = Retry.AFTER_FIX  # the arm may have stopped in the middle of an action, so a person must check first


class JournalError(CellError):
    """The journal cannot be written, so no task may start; or it cannot be read, or its chain is broken."""

    retry = Retry.AFTER_FIX


class StepFailed(CellError):
    """A step of a mission did not succeed, or was not begun because a condition was unmet or unknown."""

    retry = Retry.AFTER_FIX


class HistoryError(CellError):
    """The history of readings cannot be written, so no reading may be reported; or it cannot be read."""


class Unauthenticated(CellError):
    """The service has keys, and the request came without a valid one."""

    retry = Retry.AFTER_FIX


class Forbidden(CellError):
    """The role of the key does not permit the request."""

    retry = Retry.AFTER_FIX


class KeysUnusable(CellError):
    """The file of keys cannot be used, so no key is accepted."""

    retry = Retry.AFTER_FIX


class FileFault(CellError):
    """A file or folder cannot be written or read: it is missing, permission is missing, or the disk is full."""

    retry = Retry.AFTER_FIX


class Defect(CellError):
    """A defect of this program; the text names what failed, and the log has the details."""


def of_file(error: Exception) -> CellError | None:
    """Return the `CellError` for an error of the file system; None for any other error.

    The error of a write to a full disk names no file; that of an open or a `mkdir` does.
    """
    if not isinstance(error, OSError) or (error.filename is None and error.errno not in FULL):
        return None
    where = "the disk" if error.filename is None else str(error.filename)
    return FileFault(
        f"{where} cannot be used: {error.strerror or error}",
        hint="see that its folder exists and may be written to, and that the disk has room",
    )
