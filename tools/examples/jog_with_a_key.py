"""Jog while a key is held: a and d along x, s and w along y, q and e about the centre; x ends. [ROBOT [LOCATOR]]."""

import os
import select
import sys
import termios
import tty

from trirail import Robot

V, W = 0.02, 0.2  # [m/s], [rad/s]
KEYS = {"a": (-V, 0, 0), "d": (V, 0, 0), "s": (0, -V, 0), "w": (0, V, 0), "q": (0, 0, W), "e": (0, 0, -W)}
HELD = 0.7  # a key that is not repeated within this time has been released [s]; terminals begin after 0.3 to 0.6 s


def key(within: float | None = None) -> str:
    """Return the next key, or "" if no key is pressed `within` this time [s]."""
    ready, _, _ = select.select([sys.stdin], [], [], within)
    return os.read(sys.stdin.fileno(), 1).decode(errors="replace") if ready else ""


before = termios.tcgetattr(sys.stdin)
try:
    tty.setcbreak(sys.stdin)
    with Robot(*sys.argv[1:]) as robot:
        robot.enable()
        print("hold a key", flush=True)
        while (pressed := key()) != "x":
            if pressed in KEYS:
                x, y, phi = KEYS[pressed]
                with robot.jog(x=x, y=y, phi=phi):  # renewed automatically; if this program ends, the robot brakes
                    while key(HELD) == pressed:
                        pass
                print("stands at", *(f"{value:.4f}" for value in robot.state().pose), flush=True)
finally:
    termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)
