"""Which SYNC a drive's newest position answers; the position does not say it."""

from __future__ import annotations

from trirail_drivers.driver.cyclic import Row


class Answers:
    """Counts SYNCs and the positions that answer them.

    Answers take less than a cycle, so one that is there before the next SYNC is sent answers the last one. One that
    comes just after a SYNC answers that one where the one before is answered, or where the drive's answers have been
    so prompt; else it is the late answer to the one before.
    """

    __slots__ = ("_between", "_prompt", "late", "lost", "sampled", "syncs")

    def __init__(self) -> None:
        self.syncs = 0
        """How many were sent."""
        self.sampled = 0
        """The number of the SYNC at which the position was sampled."""
        self.late = 0
        """Answers that came a cycle later than the one before: a drive that always takes so long is not late."""
        self.lost = 0
        """SYNCs that were never answered, as far as later answers show."""
        self._between = False
        """This cycle's frames have been read, and the next SYNC was not sent."""
        self._prompt = False
        """The last position came before the cycle of its SYNC had read."""

    @property
    def age(self) -> int:
        """SYNCs sent after the one at which the position was sampled."""
        return self.syncs - self.sampled

    @property
    def missed(self) -> int:
        """SYNCs without an answer; one whose answer is not due yet does not count."""
        return self.age - (not self._prompt)

    def sync_sent(self) -> None:
        """Count a SYNC: positions that come from now on may be answers to it."""
        self.syncs += 1
        self._between = False

    def read_over(self) -> None:
        """This cycle's frames have been read: positions that come from now on answer its SYNC, but late."""
        self._between = True

    def come(self) -> None:
        """Take in that a position has come."""
        to_the_one_before = not self._between and not self._prompt and self.sampled < self.syncs - 1
        sampled = self.syncs - to_the_one_before
        self.lost += max(0, sampled - self.sampled - 1)
        self.late += self._prompt and self._between and sampled > self.sampled
        self.sampled = sampled
        self._prompt = not self._between and not to_the_one_before

    def lend(self, row: Row) -> None:
        """Write what is kept into a row of trirail_drivers.driver.cyclic.AXIS."""
        row["syncs"], row["sampled"], row["late"], row["lost"] = self.syncs, self.sampled, self.late, self.lost
        row["between"], row["prompt"] = self._between, self._prompt

    def take_back(self, row: Row) -> None:
        """Go on from there."""
        self.syncs, self.sampled, self.late, self.lost = row["syncs"], row["sampled"], row["late"], row["lost"]
        self._between, self._prompt = bool(row["between"]), bool(row["prompt"])

    def forgive(self) -> None:
        """Forget what has not been answered."""
        self.sampled = self.syncs
