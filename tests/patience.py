"""Services for tests that are about something else than how fast the machine is."""

from pathlib import Path


def patient(config: Path) -> Path:
    """Have a service go on where a busy machine stalls it for a second: neither the loop nor the drives give up."""
    text = config.read_text(encoding="utf-8")
    for before, after in {
        "max_overruns = 100 ": "max_overruns = 1000 ",
        "missed_syncs = 150 ": "missed_syncs = 2000 ",
        "heartbeat = 0.1\n": "heartbeat = 1.0\n",
    }.items():
        assert text.count(before) == 1, before
        text = text.replace(before, after)
    config.write_text(text, encoding="utf-8")
    return config
