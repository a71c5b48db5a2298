"""Arrangement of `trirail --help`: groups of commands in the order of use, with examples for each command."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Final

from cyclopts import App, Group

Examples = tuple[str, ...]

GROUPS: Final[Mapping[str, Mapping[str, Examples]]] = {
    "Begin": {
        "demo": ("trirail demo", "trirail demo --stay"),
        "doctor": ("trirail doctor", "trirail doctor robot.toml", "trirail doctor can0"),
        "config": ("trirail config", "trirail config copy socketcan robot.toml", "trirail config show robot.toml"),
        "drives": (
            "trirail drives robot.toml",
            "trirail drives robot.toml --apply",
            "trirail drives save backup --config robot.toml",
            "trirail drives compare backup/drive-A.dcf --config robot.toml",
            "trirail drives restore backup/drive-A.dcf --config robot.toml",
        ),
        "commission": ("trirail commission robot.toml", "trirail commission robot.toml --yes --fault 'A reversed'"),
        "run": ("trirail run", "trirail run robot.toml", "trirail run robot.toml --record session.rrd"),
        "keys": (
            "trirail keys init --address 192.168.1.7",
            "trirail keys add ann --role operator",
            "trirail keys list",
        ),
        "router": ("trirail router router.toml",),
        "completion": ("trirail completion bash --install", "trirail completion zsh"),
    },
    "Power and stops": {
        "enable": ("trirail enable", "trirail enable --connect tcp/192.168.1.7:7447 --robot left"),
        "disable": ("trirail disable",),
        "stop": ("trirail stop",),
        "quick-stop": ("trirail quick-stop",),
        "reset": ("trirail reset",),
        "home": ("trirail home",),
        "acquire": ("trirail acquire", "trirail acquire --force"),
        "release": ("trirail release",),
    },
    "Motion": {
        "goto": (
            "trirail goto 30mm 20mm 10deg --wait",
            "trirail goto -0.05 0 0 --speed 0.2",
            "trirail goto 50mm 0 0 --blend 10mm",
            "trirail goto 50mm 0 0 --tool 20mm 0",
            "trirail goto 10mm 0 0 --tool camera --frame part",
            "trirail goto pick --wait",
        ),
        "move": ("trirail move 5mm 0 0 --frame platform", "trirail move 0 0 1deg --tool 20mm 0 --wait"),
        "goal": ("""trirail goal '{"kind": "sliders", "position": [0.02, 0, -0.01]}' --wait""",),
        "sliders": ("trirail sliders 20mm 0 -10mm --wait",),
        "jog": (
            "trirail jog",
            "trirail jog 10mm/s 0 0",
            "trirail jog 0 0 -2deg/s --seconds 3",
        ),
        "follow": ("trirail follow path.csv --wait", "trirail follow path.csv --stretch"),
        "teach": ("trirail teach pick",),
        "forget": ("trirail forget pick",),
        "poses": ("trirail poses", "trirail poses --json"),
        "panel": ("trirail panel", "trirail panel --open", "trirail panel --port 9000 --token panel.token"),
        "align": (
            "trirail align calibrate camera.json --program ./marks",
            "trirail align run camera.json --camera left=0 --camera right=1 --shape disc --size 80",
            "trirail align check camera.json --pictures shots --json",
            "trirail align geometry robot.toml --field 4096 3000 --program ./marks --looks 4",
        ),
        "pause": ("trirail pause",),
        "resume": ("trirail resume",),
        "override": ("trirail override 50",),
        "output": ("trirail output valve on", "trirail output valve off"),
    },
    "Look": {
        "status": ("trirail status", "trirail status --json"),
        "watch": ("trirail watch",),
        "fleet": ("trirail fleet --connect tls/192.168.1.9:7447", "trirail fleet --json"),
        "events": (
            "trirail events",
            "trirail events --last 20",
            "trirail events --last 20 --follow",
            "trirail events --json",
        ),
        "view": (
            "trirail view",
            "trirail view --web",
            "trirail view session.rrd",
            "trirail view --connect tcp/192.168.1.7:7447",
            "trirail view --robot left --robot right",
        ),
    },
    "Recordings": {
        "sessions": (
            "trirail sessions",
            "trirail sessions --since 2026-01-31 --fault emcy",
            "trirail sessions /var/lib/trirail --user ann --outcome faulted --json",
        ),
        "report": ("trirail report session.rrd", "trirail report session.rrd --plot session.png"),
        "export": (
            "trirail export session.rrd --out session.parquet",
            "trirail export session.rrd --from 2s --to 5s --every 10ms --columns pose,error",
            "trirail export session.rrd --goal g-17",
            "trirail export --format mcap session.rrd --every 10ms",
            "trirail export urdf robot.toml --out robot.urdf",
        ),
        "replay": (
            "trirail replay session.rrd",
            "trirail replay session.rrd --config other.toml",
        ),
    },
    "Mathematics": {
        "ik": ("trirail ik 20mm -10mm 10deg", "trirail ik 20mm 0 0 --velocity 50mm/s 0 5deg/s"),
        "fk": ("trirail fk 10mm 0 -10mm",),
        "workspace": ("trirail workspace", "trirail workspace --plot workspace.png --phi -20deg 0 20deg"),
    },
}
"""Commands by group, each with example command lines."""
ADVANCED_COMMANDS: Final = (
    *("keys", "router", "completion", "acquire", "release", "goal", "fleet", "replay"),
    *GROUPS["Mathematics"],
)
"""Commands that a new user does not need; only `trirail help all` shows them."""
MORE: Final = "`trirail help all` shows the seldom needed commands too, `trirail help COMMAND` what one takes."


def arrange(app: App) -> None:
    """Assign each command to its group and add its examples; commands without a group go into a last group."""
    for name, commands in GROUPS.items():
        group = Group.create_ordered(name)
        for position, (command, examples) in enumerate(commands.items()):
            page = app[command]
            page.group, page.sort_key, page.show = (group,), position, command not in ADVANCED_COMMANDS
            page.help_epilogue = "```\n" + "\n".join(examples) + "\n```"
    _arrange_others(app)
    app["help"].show = False
    app.help_epilogue = MORE


def _arrange_others(app: App) -> None:
    """Put commands without a group into a last group, so that a new command needs no entry here to be in the help."""
    listed = {"help", *(command for commands in GROUPS.values() for command in commands)}
    others = [name for name in app if name not in listed and not name.startswith("-")]
    for position, command in enumerate(others):
        app[command].group, app[command].sort_key = (Group.create_ordered("Other commands"),), position


@contextmanager
def show_all(app: App) -> Iterator[None]:
    """Show every command on the page of all commands until the context ends."""
    for command in ADVANCED_COMMANDS:
        app[command].show = True
    app.help_epilogue = None
    try:
        yield
    finally:
        for command in ADVANCED_COMMANDS:
            app[command].show = False
        app.help_epilogue = MORE
