"""Matches PDOs to SYNCs by counting both, because a PDO does not say which SYNC it answers."""

from __future__ import annotations

PDOS = 2  # PDOs of a drive per SYNC
PROBE_S = 0.1  # a probe unanswered for this long counts as lost


class SyncCount:
    """Counts the SYNCs that one drive has not answered yet.

    A drive answers in order, so its next PDO belongs to the oldest unanswered SYNC. If more than one SYNC is
    unanswered, the answers may be late or lost, and a PDO cannot be assigned to a SYNC. A probe, an SDO request sent
    after those SYNCs, decides: once it is answered, PDOs that are still missing will never come, and if none is
    missing, none was lost. A drive whose PDOs overtake its SDO answers is detected by the first probe; from then on
    only a probe with no SYNC after it is conclusive, so such a drive `needs_rest` while a SYNC is unanswered.

    The PDOs of a drive alternate, so the same PDO with the same data twice in a row is a duplicate. It is not counted:
    if several were outstanding, it would pass for the answer to the next SYNC.
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
        """Return the number of the SYNC that all newest PDOs belong to; None if unknown or not the same for all."""
        first = self._answered[0]
        return first if all(number == first for number in self._answered) else None

    @property
    def owed(self) -> int:
        """Return the number of SYNCs whose PDOs have not all arrived."""
        return max(self._owed)

    @property
    def needs_rest(self) -> bool:
        """Return whether no SYNC may be sent until the next probe has been answered."""
        return self._is_overtaking is True and any(self._owed)

    def synced(self) -> None:
        """Count a SYNC that has been sent; the first has number 1."""
        self._sent += 1
        self._owed = [owed + 1 for owed in self._owed]
        if self._syncs_since_probe is not None:
            self._syncs_since_probe += 1

    def took(self, pdo: int, data: bytes) -> bool:
        """Count a received PDO with number `pdo`; return whether it is new.

        An unexpected PDO makes it unknown which of two is the newer one; a duplicate has no effect.
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
        """Return whether to send a probe before the next SYNC: answers are outstanding or unknown, and no probe is pending."""
        is_on_its_way = self._syncs_since_probe is not None and now_s - self._probed_s < PROBE_S
        return (any(self._owed) or self._is_overtaking is None) and not is_on_its_way

    def probed(self, now_s: float) -> None:
        """Record that a probe has been sent; an earlier one no longer counts."""
        self._syncs_since_probe, self._probed_s = 0, now_s
        self.probes += 1

    def probe_answered(self) -> None:
        """Count only SYNCs since the probe as unanswered.

        If exactly these were, the earlier assignment of PDOs was right.
        """
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
