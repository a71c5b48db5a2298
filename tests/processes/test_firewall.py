"""The shipped firewall rules, in a network of their own: one address that connects again and again keeps nobody out."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest
from control_rig import CONFIG
from trirail.cli import probes
from trirail.cli.doctor import network
from trirail.cli.machine import Machine
from trirail.config import Tls, Zenoh

RULES = Path(__file__).parents[2] / "configs" / "trirail.nft"
PORT, BURST, RATE = 7447, 10, 2.0
FLOOD = """
import json, select, socket, sys, time
listener = socket.create_server(("127.0.0.1", int(sys.argv[1])), backlog=1024)
began, taken = time.monotonic(), 0
for _ in range(600):
    caller = socket.socket()
    caller.bind(("127.0.0.2", 0))
    caller.setblocking(False)
    caller.connect_ex(listener.getsockname())
    while select.select([listener], [], [], 0)[0]:
        listener.accept()[0].close()
        taken += 1
    caller.close()
flooded = time.monotonic() - began
other = socket.create_connection(listener.getsockname(), timeout=30, source_address=("127.0.0.3", 0))
listener.accept()
print(json.dumps({"taken": taken, "flooded": flooded, "other": other.getsockname()[0]}))
"""


def _can() -> bool:
    if os.geteuid() != 0 or shutil.which("nft") is None or shutil.which("unshare") is None:
        return False
    return (
        subprocess.run(("unshare", "--net", "nft", "list", "tables"), capture_output=True, check=False).returncode == 0
    )


needs_nft = pytest.mark.skipif(
    not _can(), reason="needs root, nft and nf_tables in the kernel: .ci/packages installs it"
)


def flood(rules: str, port: int) -> dict[str, float | str]:
    """Flood a port from one address in a network with these rules; then connect from another address."""
    setup = f"ip link set lo up; {rules} {sys.executable} -c '{FLOOD}' {port}"
    done = subprocess.run(("unshare", "--net", "sh", "-ec", setup), capture_output=True, check=True, timeout=120)
    return dict(json.loads(done.stdout))


@needs_nft
def test_one_address_gets_few_connections_and_another_its_own() -> None:
    told = flood(f"nft -f {RULES}; nft -f {RULES};", PORT)
    assert float(told["taken"]) <= BURST + 1 + RATE * float(told["flooded"])
    assert told["other"] == "127.0.0.3"


@needs_nft
def test_ports_that_are_not_named_have_no_limit() -> None:
    assert flood(f"nft -f {RULES};", PORT + 1000)["taken"] == 600
    assert flood("", PORT)["taken"] == 600


@needs_nft
def test_the_doctor_reads_which_ports_are_limited() -> None:
    read = "from trirail.cli import probes; print(probes.limited_ports())"
    for rules, found in (("", ()), (f"nft -f {RULES};", (PORT,))):
        command = ("unshare", "--net", "sh", "-ec", f"{rules} {sys.executable} -c '{read}'")
        assert subprocess.run(command, capture_output=True, check=True, text=True).stdout == f"{found}\n"


def test_without_nft_nothing_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "/nowhere")
    assert probes.limited_ports() is None


@pytest.mark.parametrize(
    ("ports", "verdicts"), [(None, []), ((), ["warning"]), ((PORT,), ["warning"]), ((PORT, 7449), ["ok"])]
)
def test_the_doctor_names_the_ports_without_a_limit(ports: tuple[int, ...] | None, verdicts: list[str]) -> None:
    served = Zenoh(("tls/0.0.0.0:7447", "tls/[::]:7449", "unixsock-stream//run/z"), tls=Tls())
    machine = Machine("", True, True, (), None, 0.0, 0, {}, (), None, "", limited_ports=ports)
    config = msgspec.structs.replace(CONFIG, zenoh=served)
    found = [check for check in network(config, machine) if check.name == "firewall"]
    assert [check.verdict for check in found] == verdicts
    assert all("7449" in check.remedy for check in found if check.verdict == "warning")
