"""How long `trirail sessions` takes over a folder of many recordings: python tools/bench_sessions.py [NUMBER].

The recordings are empty files; the index has of each what a session of an hour leaves there.
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from trirail.processes.interpreter import python
from trirail.telemetry.contents import Contents, FaultEntry
from trirail.telemetry.session_index import SessionIndex, Wanted
from trirail.wire.messages import FaultDetail

WANTED = {
    "all": Wanted(),
    "one robot": Wanted(robot="robot-3"),
    "one fault": Wanted(fault="0x8611"),
    "one user's faulted": Wanted(user="user-4", outcome="faulted"),
    "one day": Wanted(since=1.75e9 + 86_400 * 100, until=1.75e9 + 86_400 * 101),
}
AGAIN = 5


def recordings(number: int) -> Iterator[Contents]:
    """Yield what is in so many sessions of ten robots and twenty users."""
    for n in range(number):
        began, users = 1.75e9 + 3600.0 * n, [f"user-{(n + k) % 20}" for k in range(3)]
        goals = Counter(
            {(user, outcome): 10 for user in users for outcome in ("done", "faulted", "stopped")[: 1 + n % 3]}
        )
        faults = [
            FaultEntry(began + k, FaultDetail("emcy", "B", 0x8611 if n % 500 == 1 else 0x8700), "drive B")
            for k in range(n % 4)
        ]
        name = f"robot-{n % 10}-{time.strftime('%Y%m%d-%H%M%S', time.gmtime(began))}.rrd"
        yield Contents(name, f"robot-{n % 10}", began, began + 3600.0, 3_600_000, dict.fromkeys(users), goals, faults)


def main() -> None:
    """Measure, and print the median of a few times."""
    number = int(sys.argv[1]) if len(sys.argv) > 1 else 10_000
    with tempfile.TemporaryDirectory() as named:
        folder = Path(named)
        index = SessionIndex(folder)
        made = list(recordings(number))
        index.put(made)
        for each in made:
            (folder / each.name).touch()
        for called, wanted in WANTED.items():
            took, found = [], 0
            for _ in range(AGAIN):
                began = time.perf_counter()
                for _ in index.update():
                    pass
                found = len(index.find(wanted))
                took.append(time.perf_counter() - began)
            print(f"{called:20} {statistics.median(took) * 1e3:7.0f} ms, {found} of {number} sessions")
        command = python("-m", "trirail", "sessions", named, "--fault", "0x8611")
        took = []
        for _ in range(AGAIN):
            began = time.perf_counter()
            subprocess.run(command, stdout=subprocess.DEVNULL, check=True)
            took.append(time.perf_counter() - began)
        print(f"{'the command':20} {statistics.median(took) * 1e3:7.0f} ms, with the start of Python")


if __name__ == "__main__":
    main()
