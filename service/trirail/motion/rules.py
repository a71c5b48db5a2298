"""Version of the rules by which the loop changes the rate of a motion. Recordings name it, and replays follow it."""

from typing import Final

RULES: Final = 3
"""1: only fractions of the quickest change at full speed. 2: also fractions of the quickest at the present speed.
3: stops are first tried as those of a straight motion; see trirail.motion.straight_stop."""
