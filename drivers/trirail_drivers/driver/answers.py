"""Which SYNC a drive's newest position answers; the position does not say it."""

from __future__ import annotations

from trirail_drivers.driver.axis_row import AxisRow


class Answers(AxisRow):
    """Counts SYNCs and the positions that answer them.

    Answers take less than a cycle, so one that is there before the next SYNC is sent answers the last one. One that
    comes just after a SYNC answers that one where the one before is answered, or where the drive's answers have been
    so prompt; else it is the late answer to the one before.
    """

    @property
    def age(self) -> int:
        """SYNCs sent after the one at which the position was sampled."""
        return self.syncs - self.sampled

    @property
    def missed(self) -> int:
        """SYNCs without an answer; one whose answer is not due yet does not count."""
        return self.syncs - self.sampled - (not self.prompt)

    def sync_sent(self) -> None:
        """Count a SYNC: positions that come from now on may be answers to it."""
        self.syncs += 1
        self.between = False

    def read_over(self) -> None:
        """This cycle's frames have been read: positions that come from now on answer its SYNC, but late."""
        self.between, self.came = True, False

    def answer(self) -> None:
        """Take in that a position has come: it is the answer to a SYNC."""
        self.came = True
        between, prompt, before, syncs = self.between, self.prompt, self.sampled, self.syncs
        to_the_one_before = not between and not prompt and before < syncs - 1
        sampled = syncs - to_the_one_before
        if sampled - before > 1:
            self.lost += sampled - before - 1
        if prompt and between and sampled > before:
            self.late += 1
        self.sampled = sampled
        self.prompt = not between and not to_the_one_before

    def forgive_unanswered(self) -> None:
        """Forget what has not been answered."""
        self.sampled = self.syncs
