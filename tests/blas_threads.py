"""The process that runs tests computes with one thread: imported before anything imports numpy.

Threads of numpy's and scipy's libraries wait for each other by spinning. Where every processor has a worker of its own,
fitting a mark in a picture took them five times the processor time. Programs that tests start have as many as users'.
"""

import pytest
from trirail.processes.operating_system import ONE_THREAD

with pytest.MonkeyPatch.context() as environment:
    for name, value in ONE_THREAD.items():
        environment.setenv(name, value)
    import numpy.linalg  # noqa: F401 - each library reads the environment when it is loaded
    import scipy.linalg  # type: ignore[import-untyped]  # noqa: F401 - as above
