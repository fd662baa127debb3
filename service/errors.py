"""Errors that only the service knows, in the same tree."""

from __future__ import annotations

from hal.errors import CellError, InvalidRequest, LeaseError, Retry


class Busy(CellError):
    """A queue is full; nothing was accepted."""

    retry = Retry.SAFE


class NoSuchTask(InvalidRequest):
    """No task or artefact has that name."""


class NotPossibleNow(CellError):
    """The thing exists, but its state does not allow this."""

    retry = Retry.AFTER_FIX


class StaleEpoch(LeaseError):
    """The lease that came with the command is not the present one."""


class Aborted(CellError):
    """The service ended while the task ran; the arm was stopped. The task was not taken up again."""

    retry = Retry.SAFE


class JournalError(CellError):
    """The journal cannot be written, so nothing may start: no audit, no motion."""

    retry = Retry.AFTER_FIX


class Defect(CellError):
    """A fault in our own program; the text names what failed, the log has the rest."""
