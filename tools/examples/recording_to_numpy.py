"""Read a recording, which may still be written at the time: python recording_to_numpy.py FILE.rrd."""

import sys
from pathlib import Path

import numpy as np
from trirail import read

recording = read(Path(sys.argv[1]))
records = recording.records  # one for each cycle; trirail.wire.records describes the fields
error = records["following_error"]  # (N, 3) [m]: setpoint minus measured position of the sliders A, B, C
print(f"{recording.name}: {len(records)} cycles, {recording.t[-1] - recording.t[0]:.1f} s")
print("following error, rms:", *(f"{rms * 1e6:.1f} µm" for rms in np.sqrt(np.mean(error**2, axis=0))))
late = records["lateness_ns"] / 1e3
print(f"lateness: median {np.median(late):.0f} µs, most {late.max():.0f} µs")
for line in recording.events:
    print(f"{line.t:9.3f} s  {line.level:5}  {line.text}")
