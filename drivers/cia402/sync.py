"""Which SYNC does a PDO answer? It does not say, so SYNCs and PDOs are counted."""

from __future__ import annotations

PDOS = 2  # of a drive on each SYNC
PROBE_S = 0.1  # a probe that was not answered for so long is lost


class SyncCount:
    """Counts what one drive owes.

    A drive answers in order, so its next PDO belongs to the oldest SYNC that it has not answered. One that owes more may be
    late or have lost some, and what it sends then is of no known SYNC. Which of the two, a probe tells: when an SDO that
    was asked after those SYNCs has been answered, what has not come by then never will, and if nothing is missing by then,
    nothing was lost. A drive whose PDOs overtake its SDO answers is found out by the first probe, and then only a probe
    without any SYNC after it tells: such a drive `needs_rest` while it owes anything.

    Its PDOs come in turn, so the same PDO with the same data twice running is one that was sent once and came twice. It is
    not counted: among several that are owed it would pass for the answer to the next SYNC.
    """

    def __init__(self) -> None:
        self._sent = 0
        self._owed = [0] * PDOS
        self._answered: list[int | None] = [None] * PDOS
        self._last = [b""] * PDOS
        self._newest: int | None = None
        self._is_overtaking: bool | None = None
        self._syncs_since_probe: int | None = None
        self._probed_s = 0.0
        self.probes = 0

    @property
    def answered(self) -> int | None:
        """Number of the SYNC that all newest PDOs belong to; None when that is not known, or not one and the same."""
        first = self._answered[0]
        return first if all(number == first for number in self._answered) else None

    @property
    def owed(self) -> int:
        """SYNCs whose PDOs have not all come."""
        return max(self._owed)

    @property
    def needs_rest(self) -> bool:
        """Is no SYNC to be sent before the next probe has been answered?"""
        return self._is_overtaking is True and any(self._owed)

    def synced(self) -> None:
        """A SYNC has been sent; the first has number 1."""
        self._sent += 1
        self._owed = [owed + 1 for owed in self._owed]
        if self._syncs_since_probe is not None:
            self._syncs_since_probe += 1

    def took(self, pdo: int, data: bytes) -> bool:
        """PDO number `pdo` has come; tells whether it is a new one.

        One that was not owed is a stray, and then it is not known which of the two is young; the same twice is no matter.
        """
        is_repeat = pdo == self._newest and data == self._last[pdo]
        self._newest = pdo
        if is_repeat:
            return False
        if self._owed[pdo] == 0:
            if data != self._last[pdo]:
                self._answered[pdo] = None
            return False
        self._owed[pdo] -= 1
        self._answered[pdo] = None if self._owed[pdo] else self._sent
        self._last[pdo] = data
        return True

    def wants_probe(self, now_s: float) -> bool:
        """Asked just before a SYNC: is something owed (or nothing known yet), and no probe on its way?"""
        is_on_its_way = self._syncs_since_probe is not None and now_s - self._probed_s < PROBE_S
        return (any(self._owed) or self._is_overtaking is None) and not is_on_its_way

    def probed(self, now_s: float) -> None:
        """A probe has been sent; an earlier one no longer counts."""
        self._syncs_since_probe, self._probed_s = 0, now_s
        self.probes += 1

    def probe_answered(self) -> None:
        """Only the SYNCs since the probe are still owed; if just these are, what came before is what it was taken for."""
        since = self._syncs_since_probe
        if since is None:
            return
        self._syncs_since_probe = None
        self._is_overtaking = self._is_overtaking or any(owed < since for owed in self._owed)
        if self._is_overtaking and since:
            return
        for pdo in range(PDOS):
            if self._owed[pdo] == since and self._last[pdo]:
                self._answered[pdo] = self._sent - since
            self._owed[pdo] = since
