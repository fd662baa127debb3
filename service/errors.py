"""Errors that only the service knows, in the same tree."""

from __future__ import annotations

import errno

from hal.errors import CellError, DeviceUnavailable, InvalidRequest, LeaseError, Retry

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)


class Busy(CellError):
    """A queue is full; nothing was accepted."""

    retry = Retry.SAFE


class NoSuchTask(InvalidRequest):
    """No task or artefact has that name."""


class NoSuchMission(NoSuchTask):
    """No mission has left a file of that name."""


class NoSuchDevice(NoSuchTask):
    """The cell file has no device of that name."""


class DevicesUnavailable(DeviceUnavailable):
    """Several devices did not connect; the details say why each, and what to do."""

    retry = Retry.AFTER_FIX


class NotConnected(DeviceUnavailable):
    """The device did not connect when the cell started, nor when somebody tried again; the rest of the cell works."""

    retry = Retry.AFTER_FIX


class NotPossibleNow(CellError):
    """The thing exists, but its state does not allow this."""

    retry = Retry.AFTER_FIX


class StaleEpoch(LeaseError):
    """The lease that came with the command is not the present one."""


class Aborted(CellError):
    """The service ended while the task ran; the arm was stopped. The task was not taken up again."""

    retry = Retry.AFTER_FIX  # the arm may stand in the middle of a deed: a person looks first


class JournalError(CellError):
    """The journal cannot be written, so nothing may start (no audit, no motion); or it cannot be read or trusted."""

    retry = Retry.AFTER_FIX


class FileFault(CellError):
    """A file or folder cannot be written or read: not there, no right, no room."""

    retry = Retry.AFTER_FIX


class Defect(CellError):
    """A fault in our own program; the text names what failed, the log has the rest."""


def of_file(error: Exception) -> CellError | None:
    """What an error of the file system says to a person; None when it is about something else.

    A write to a full disk names no file, an open or a `mkdir` does.
    """
    if not isinstance(error, OSError) or (error.filename is None and error.errno not in FULL):
        return None
    where = "the disk" if error.filename is None else str(error.filename)
    return FileFault(
        f"{where} cannot be used: {error.strerror or error}",
        hint="see that its folder exists and may be written to, and that the disk has room",
    )
