"""Quantities of the command line: what is printed can be typed, whatever else is no quantity is refused in a line."""

from __future__ import annotations

import contextlib
import json
import math
import re
import sys
from collections.abc import Callable, Iterator
from decimal import Decimal
from pathlib import Path

import pytest
from cyclopts import App, Argument, Token
from hypothesis import assume, given
from hypothesis import strategies as st
from trirail.cli import app, notation
from trirail.cli.notation import written
from trirail.wire import text
from trirail.wire.units import ANGLE, DIMENSIONS, LENGTH, Dimension, quantity

Run = Callable[..., tuple[int, str, str]]
a_unit = st.sampled_from([(dimension, unit) for dimension in DIMENSIONS for unit in dimension.units])
a_value = st.floats(-1e3, 1e3)


@given(a_unit, a_value, st.integers(0, 9), st.integers(0, 12))
def test_what_is_printed_is_taken_again_to_its_digits(
    kind: tuple[Dimension, str], value: float, digits: int, width: int
) -> None:
    dimension, unit = kind
    printed = written(value, unit, digits, width)
    size = float(dimension.units[unit])
    assert abs(quantity(printed, dimension) - value) <= (0.5000001 * 10.0**-digits + 1e-12 * abs(value) / size) * size
    assert quantity(printed.replace(" ", ""), dimension) == quantity(printed, dimension)


@given(a_value, a_value, st.floats(-math.pi, math.pi))
def test_a_printed_pose_is_one_that_can_be_typed(x: float, y: float, phi: float) -> None:
    words = re.fullmatch(r"x(.*mm) {3}y(.*mm) {3}φ(.*°)", notation.pose((x, y, phi), 9))
    assert words is not None
    assert quantity(words[1], LENGTH) == pytest.approx(x, abs=0.51e-6)
    assert quantity(words[2], LENGTH) == pytest.approx(y, abs=0.51e-6)
    assert quantity(words[3], ANGLE) == pytest.approx(phi, abs=math.radians(0.51e-4))


@given(st.decimals(-1000, 1000, places=3))
def test_arcseconds_are_a_sixtieth_of_arcminutes_and_these_of_degrees(value: Decimal) -> None:
    degrees = quantity(f"{value}deg", ANGLE)
    assert quantity(f"{value * 60}arcmin", ANGLE) == pytest.approx(degrees, rel=1e-15, abs=1e-18)
    assert quantity(f"{value * 3600}arcsec", ANGLE) == pytest.approx(degrees, rel=1e-15, abs=1e-18)


@given(st.decimals(-1000, 1000, places=3))
def test_a_unit_and_the_bare_number_are_the_same_number(number: object) -> None:
    assert quantity(f"{number}mm", LENGTH) == float(f"{number}e-3")
    assert quantity(f"{number} um", LENGTH) == quantity(f"{number}µm", LENGTH) == float(f"{number}e-6")
    assert quantity(f"{number}", LENGTH) == float(f"{number}")
    assert quantity(f"{number}deg", ANGLE) == pytest.approx(math.radians(float(f"{number}")), rel=1e-15)


def test_an_inch_is_exact() -> None:
    assert quantity("-0.2in", LENGTH) == -0.00508


@given(st.decimals("0.001", 1, places=4))
def test_a_share_is_a_number_or_a_percentage(value: Decimal) -> None:
    assert notation.share(str(value)) == float(value)
    assert notation.share(f"{100 * value}%") == pytest.approx(float(value), rel=1e-15)


@given(st.decimals(allow_nan=False, allow_infinity=False).filter(lambda value: not Decimal("0.001") <= value <= 1))
def test_a_share_is_from_a_thousandth_to_one(value: Decimal) -> None:
    with pytest.raises(ValueError, match=r"0\.001 to 1, or 0\.1% to 100%"):
        notation.share(str(value))


def is_quantity(word: str) -> bool:
    """Whether a word of the command line is a quantity of any kind."""
    for dimension in DIMENSIONS:
        with contextlib.suppress(ValueError):
            quantity(word, dimension)
            return True
    return False


@given(
    st.from_regex(r"[A-Za-z0-9_-]{1,6}", fullmatch=True)
    | st.tuples(st.integers(-99, 99).map(str), st.sampled_from(["", "e3", "E-3"]), a_unit).map(
        lambda parts: parts[0] + parts[1] + parts[2][1]
    )
)
def test_a_name_is_no_pose_where_the_command_line_reads_a_quantity(word: str) -> None:
    assume(text.is_name(word))
    assert text.is_quantity(word) is is_quantity(word)


@given(st.text(), st.sampled_from(DIMENSIONS))
def test_junk_is_no_quantity(text: str, dimension: Dimension) -> None:
    try:
        value = quantity(text, dimension)
    except ValueError as error:
        said = str(error)
        assert f"is not {dimension.name} such as {dimension.examples}" in said
        assert said.isprintable()
    else:
        assert math.isfinite(value)
        assert text.strip()[0] in "+-.0123456789"


WRONG = ["", "mm", "5 parsec", "1e400", "inf", "nan", "0x10", "1_000", "٣mm", "5mm5", "--5", "5°"]


@pytest.mark.parametrize("text", WRONG)
def test_what_is_no_length(text: str) -> None:
    with pytest.raises(ValueError, match="is not a length such as 5mm"):
        quantity(text, LENGTH)


def test_negative_quantities_are_no_options(run: Run) -> None:
    code, out, err = run("fk", "-5mm", "-.1in", "-0.01", "--json")
    assert (code, err) == (0, "")
    same = run("fk", "--json", "--", "-0.005", "-0.00254", "-0.01")
    assert same == (code, out, err)


def test_an_angle_has_the_unit_that_is_said_or_that_of_deg(run: Run) -> None:
    def phi(*words: str) -> float:
        code, out, err = run("ik", "20mm", "-10mm", *words, "--json")
        assert (code, err) == (0, "")
        found = json.loads(out)["pose"]
        assert found[:2] == [0.02, -0.01]
        return float(found[2])

    assert phi("-0.1") == phi("-100mrad") == phi("-100mrad", "--deg") == -0.1
    assert phi("-5deg") == phi("-5°") == phi("-5", "--deg") == pytest.approx(math.radians(-5), rel=1e-15)


def test_what_ik_and_fk_print_is_what_they_take(run: Run) -> None:
    _, printed, _ = run("ik", "20mm", "-10mm", "5deg")
    words = printed.splitlines()[0].replace(" mm", "mm").split()
    pose = [words[1], words[3], words[5]]
    assert run("ik", *pose)[1] == printed
    sliders = re.findall(r"slider +(\S+) +(\S+) +(\S+) +mm", printed)[0]
    assert run("fk", *(f"{at}mm" for at in sliders))[1].startswith("x 20.000 mm   y -10.000 mm   φ 5.000")


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("goto 5parsec 0 0", "Invalid value for X: '5parsec' is not a length such as 5mm"),
        ("goto -5parsec 0 0", "Invalid value for X: '-5parsec' is not a length such as 5mm"),
        ("goto 0 0 3mm", "Invalid value for PHI: '3mm' is not an angle such as 1.5deg"),
        ("goto 0 0 0 --blend junk", "Invalid value for --blend: 'junk' is not a length"),
        ("jog 5mm 0 0", "'5mm' is not a velocity such as 5mm/s"),
        ("jog 0 0 1deg", "'1deg' is not an angular velocity such as 1.5deg/s"),
        ("jog 0 0 0 --seconds x", "'x' is not a time such as 2s"),
        ("override fast", "'fast' is not an override: use 0, or 1 to 200 %"),
        ("ik 0 0 0 --velocity 1 2 x", "Invalid value for velocity: 'x' is not an angular velocity"),
        ("workspace --phi 1mm", "'1mm' is not an angle"),
        ("goto -- -0.06 0 0 --speed 0.5", "--speed follows --"),
        ("goto -- -0.06 0 0 --speed=0.5", "--speed follows --"),
        ("goto 0 0 0 --sped 0.5", "Did you mean --speed?"),
        ("goto 0 0", "goto takes X, Y and PHI, but only X = 0 and Y = 0.000 mm are given"),
        ("jog 1mm/s 0", "jog takes VX, VY and W, or none of them"),
    ],
)
def test_what_is_wrong_is_one_line_that_says_what_would_be_right(line: str, said: str, run: Run) -> None:
    code, out, err = run(*line.split())
    assert (code, out) == (2, "")
    assert said in err
    assert err.count("\n") == 1
    assert err.endswith(f"(trirail {line.split(maxsplit=1)[0]} --help shows the usage)\n")


@pytest.mark.parametrize(
    ("line", "tool"),
    [
        ("goto 50mm 0 0 --tool 20mm 0", (0.02, 0.0)),
        ("goto --tool 20mm 0 50mm 0 0", (0.02, 0.0)),
        ("goto --tool -20mm -5mm -50mm 0 0", (-0.02, -0.005)),
        ("goto 0 0 0 --tool 20mm,-1mm --wait", (0.02, -0.001)),
        ("goto 0 0 0 --tool camera --wait", "camera"),
        ("goto --tool camera 0 0 0", "camera"),
        ("goto --tool=camera 0 0 0", "camera"),
        ("move 0 0 1deg --tool 2nd", "2nd"),
        ("move 0 0 1deg", None),
    ],
)
def test_a_tool_is_a_point_or_a_name(line: str, tool: object) -> None:
    _, bound, _ = app.app.parse_args(notation.numbers(line.split()), exit_on_error=False, print_error=False)
    assert bound.arguments.get("tool") == tool
    assert len([word for word in bound.args if word != ""]) == 3


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("goto 0 0 0 --tool 0.02", "'0.02' is only half a point: give U V, such as 20mm 0, or a name of [frames.tool]"),
        ("goto 0 0 0 --tool 20mm,x", "'x' is not a length"),
        ("goto 0 0 0 --tool a/b", "'a/b' is neither a point, such as 20mm 0, nor a name"),
        ("goto 0 0", "goto takes X, Y and PHI, but only X = 0 and Y = 0.000 mm are given"),
        ("goto 0.5", "goto takes X, Y and PHI, or the NAME of a pose, but only X = 0.5 is given"),
        ("goto 10 mm 20 mm 0", "write no space before"),
        (
            "goto pick --tool camera",
            "the pose of a NAME is fixed: it cannot be combined with --tool or --frame",
        ),
        ("goto pick 0 0", "Invalid value for X: 'pick' is not a length"),
    ],
)
def test_half_a_tool_or_half_a_pose_is_wrong_usage(
    line: str, said: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["trirail", *line.split()])
    with pytest.raises(SystemExit) as ended:
        app.main()
    assert ended.value.code == 2
    assert said in capsys.readouterr().err


OF_A_PICTURE = "--turn"
"""By what angle a mark is turned in a picture: degrees are more than enough."""


def arguments(app: App, path: tuple[str, ...] = ()) -> Iterator[tuple[str, Argument]]:
    """Yield every argument of every command with a name for it."""
    for name in app:
        if isinstance(inner := app[name], App) and not name.startswith("-"):
            yield from arguments(inner, (*path, name))
            if inner.default_command is not None:
                for argument in inner.assemble_argument_collection():
                    yield " ".join((*path, name, argument.name)), argument


def test_every_length_and_angle_of_the_command_line_takes_microns_and_arcseconds() -> None:
    """An argument is one by its converter, or by the unit that its help names: no other is a bare number of these."""
    taken = set()
    for name, argument in arguments(app.app):
        convert, said = argument.parameter.converter, argument.parameter.help or ""
        if not callable(convert):
            meant = re.search(r"\[(m|mm|rad|deg)\b|degree|millimetre", said)
            assert meant is None or argument.hint is bool or argument.name == OF_A_PICTURE, (name, said)
            continue
        for word, other, dimension in (("350um", "0.35mm", LENGTH), ("18arcsec", "0.005deg", ANGLE)):
            values = []
            for each in (word, other):
                tokens = [Token(keyword=None, value=each, source="", index=0)] * (argument.token_count()[0] or 1)
                with contextlib.suppress(ValueError):
                    found = convert(argument.hint, tokens)
                    first = found[0] if isinstance(found, tuple) else found
                    values.append(quantity(first, ANGLE) if isinstance(first, str) else first)
            if len(values) == 2:
                assert values[0] == pytest.approx(values[1], rel=1e-15), name
                taken.add((name.split()[0], dimension.name))
    for command in ("goto", "move", "ik"):
        assert {(command, "a length"), (command, "an angle")} <= taken
    assert {("sliders", "a length"), ("fk", "a length"), ("workspace", "an angle"), ("align", "a length")} <= taken


PAGE = Path(app.__file__).parents[1] / "panel" / "page" / "going.js"


@pytest.mark.parametrize(("name", "dimension"), [("LENGTHS", LENGTH), ("ANGLES", ANGLE)])
def test_the_page_takes_the_units_of_the_command_line(name: str, dimension: Dimension) -> None:
    """The same sizes; a bare number and the signs of minutes and seconds of arc are the page's own."""
    told = re.search(rf"^export const {name} = {{ (.*) }};$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    assert told is not None
    pairs = re.findall(r"""(?:"([^"]*)"|'(.)'|(\w+)): ([^,]+)""", told[1].replace("'\"'", "'″'").replace('"\'"', "'′'"))
    sizes = {"".join(names): float(eval(size.replace("Math.PI", "math.pi"))) for *names, size in pairs}
    assert {"mm", "um", "µm", "μm"} <= set(sizes) or {"deg", "arcsec", "°"} <= set(sizes)
    for unit in set(sizes) - {"", "′", "″"}:
        assert sizes[unit] == pytest.approx(float(dimension.units[unit]), rel=1e-12)


@given(st.integers(0, 999), st.integers(0, 999), st.sampled_from(["", "-"]), st.sampled_from(["", "mm", " m", "deg"]))
def test_a_decimal_comma_is_told_with_a_point(whole: int, part: int, sign: str, unit: str) -> None:
    with pytest.raises(ValueError, match=rf": write {sign}{whole}\.{part} with a decimal point"):
        quantity(f"{sign}{whole},{part}{unit}", LENGTH)


@given(st.text("0123456789,;. m-", max_size=8).filter(lambda text: not re.match(r"\s*-?\d+,\d+(?![\d,.])", text)))
def test_nothing_else_is_taken_for_one(text: str) -> None:
    said = ""
    try:
        quantity(text, LENGTH)
    except ValueError as error:
        said = str(error)
    assert "with a point" not in said
