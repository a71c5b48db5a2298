"""What the guides say exists: files, links, anchors, commands and their options, messages, names in Python."""

import ast
import importlib
import json
import pkgutil
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest
import trirail
import trirail_drivers
from trirail.cli.app import app
from trirail.cli.notation import numbers
from trirail.config import Config
from trirail.errors import TrirailError
from trirail.wire.goals import Goal

ROOT = Path(__file__).parents[2]
GUIDES = sorted(
    {
        *ROOT.glob("*.md"),
        *(ROOT / "service").glob("*.md"),
        *(ROOT / "drivers").glob("*.md"),
        *(ROOT / name / "README.md" for name in ("configs", "tools")),
        ROOT / "configs/stages.md",
        ROOT / "configs/align.md",
    }
)
PACKAGES = {"service": "service/trirail", "drivers": "drivers/trirail_drivers", "CONTRIBUTING.md": "service/trirail"}
"""Below which folder a guide's paths are, where they are not below its own or the checkout's."""
RAW = "https://raw.githubusercontent.com/trirail/trirail/main/"


def named(guide: Path) -> str:
    return str(guide.relative_to(ROOT))


every_guide = pytest.mark.parametrize("guide", GUIDES, ids=named)


def blocks(guide: Path, language: str) -> Iterator[str]:
    yield from re.findall(rf"^```{language}\n(.*?)^```", guide.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


def anchors(path: Path) -> set[str]:
    """Return the anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", path.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@every_guide
def test_every_link_leads_somewhere(guide: Path) -> None:
    for link in re.findall(r"\]\(([^)]+)\)", guide.read_text(encoding="utf-8")):
        if link.startswith(RAW):
            assert (ROOT / link.removeprefix(RAW)).is_file(), link
            continue
        if link.startswith("https://"):
            continue
        file, _, anchor = link.partition("#")
        target = guide.parent / file if file else guide
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


@every_guide
def test_every_file_that_is_named_exists(guide: Path) -> None:
    if guide.name == "CHANGELOG.md":
        return  # it tells of the past
    package = PACKAGES.get(guide.parent.name, PACKAGES.get(guide.name, ""))
    code = re.sub(r"^```.*?^```", "", guide.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    for name in re.findall(r"`([\w./-]+\.(?:py|toml|service|eds))`", code):
        if name in {"robot.toml", "my.toml", "maker.eds"}:
            continue  # the reader's own
        places = (ROOT, guide.parent, ROOT / package)
        assert any((place / name).is_file() for place in places), f"{name} is not in any of {package or '.'}"


def steps() -> list[str]:
    """Return the numbered steps of the lists in CONTRIBUTING.md."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    return re.findall(r"^\d\. .*\n(?:   .*\n)*", text.partition("## To add")[2], re.MULTILINE)


@pytest.mark.parametrize("step", steps())
def test_what_a_step_names_is_in_one_of_its_files(step: str) -> None:
    words = re.findall(r"`([^`\n]+)`", step)
    paths = [place / word for word in words for place in (ROOT, ROOT / "service/trirail") if (place / word).is_file()]
    code = "".join(path.read_text(encoding="utf-8") for path in paths)
    for name in (word for word in words if re.fullmatch(r"_?[A-Za-z]\w*", word)):
        if name not in {"completion"} and paths:
            assert re.search(rf"\b{name}\b", code), f"{name} is in none of {', '.join(map(str, paths))}"


@every_guide
def test_every_command_can_be_typed_as_it_is_shown(guide: Path) -> None:
    for line in "".join(blocks(guide, "sh")).splitlines():
        for command in line.partition("#")[0].split(";"):
            program, *words = shlex.split(command) or [""]
            if program == "trirail":
                words = [{"FILE": "file.rrd", "NAME": "demo"}.get(word, word) for word in words]
                app.parse_args(numbers(words), exit_on_error=False, print_error=False)
            elif program == "make":
                assert f"\n{words[0]}:" in (ROOT / "Makefile").read_text(encoding="utf-8"), command
            elif program == "python" and words[0].startswith("tools/"):
                assert (ROOT / words[0]).is_file(), command


@every_guide
def test_every_message_is_one(guide: Path) -> None:
    for line in "".join(blocks(guide, "json")).splitlines():
        msgspec.convert(json.loads(line), Goal)


@every_guide
def test_every_import_works(guide: Path) -> None:
    for block in blocks(guide, "python"):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and node.module:
                module = importlib.import_module(node.module)
                assert all(hasattr(module, alias.name) for alias in node.names), ast.unparse(node)


def test_the_readme_stays_one_for_a_newcomer() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 150
    for guide in GUIDES:
        assert (guide.name == "README.md" and guide.parent == ROOT) or f"]({named(guide)}" in text


def test_a_page_is_short_enough_to_be_read() -> None:
    words = {named(guide): len(guide.read_text(encoding="utf-8").split()) for guide in GUIDES}
    del words["configs/README.md"]  # every key, to be looked up
    assert {name: count for name, count in words.items() if count > (1000 if name == "README.md" else 1800)} == {}


def test_every_room_has_its_line() -> None:
    text = (ROOT / "service/changing.md").read_text(encoding="utf-8")
    section = text.partition("\n## The rooms\n")[2].partition("\n## ")[0]
    rooms = {path.parent.name for path in Path(trirail.__file__).parent.glob("*/__init__.py")}
    assert rooms == set(re.findall(r"^\| `(\w+)` \|", section, re.MULTILINE))


def test_every_tool_has_its_line() -> None:
    text = (ROOT / "tools/README.md").read_text(encoding="utf-8")
    tools = {str(path.relative_to(ROOT / "tools")) for path in (ROOT / "tools").rglob("*.py")}
    assert {tool for tool in tools if f"`{tool}`" not in text} == set()


def test_every_section_of_the_configuration_that_is_named_exists() -> None:
    sections = {field.name for field in msgspec.structs.fields(Config)}
    for guide in GUIDES:
        for section in re.findall(r"`\[([a-z]\w*)[\].]", guide.read_text(encoding="utf-8")):
            assert section in sections, f"{named(guide)}: [{section}]"


def test_the_tree_of_errors_is_drawn_as_it_is() -> None:
    (drawing,) = (block for block in blocks(ROOT / "service/codes.md", "") if block.startswith("TrirailError"))
    drawn = re.findall(r"^([│├└─ ]*)(\w+(?:Error|Timeout|Refused))\b", drawing, re.M)
    for package in (trirail, trirail_drivers):  # so that all of them are there
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if not module.name.endswith("__main__"):
                importlib.import_module(module.name)
    assert {(len(lines) // 4, name) for lines, name in drawn} == set(tree(TrirailError))


def tree(kind: type[Exception], depth: int = 0) -> Iterator[tuple[int, str]]:
    """Yield the errors below one, each with its depth."""
    yield depth, kind.__name__
    for below in kind.__subclasses__():
        yield from tree(below, depth + 1)
