"""Description of the mechanism as URDF, with simple shapes instead of meshes.

The joints have the same names as in exported recordings. URDF allows only trees of links. Therefore the platform is
attached only to leg A, and each of the legs B and C ends in a separate link at the platform's centre. The ends of all
legs coincide if the positions of all joints belong to the same pose.
"""

from __future__ import annotations

import math
from xml.etree import ElementTree as ET

from trirail.config import Limits
from trirail.kinematics.geometry import Geometry
from trirail.kinematics.leg import AnyLeg

BASE, PLATFORM = "base", "platform"
RAIL_M, CARRIAGE_M, SLIDE_M, PLATFORM_M = 0.006, 0.02, 0.005, 0.008
"""Thicknesses in the drawing [m]."""
COLOURS = {"rail": "0.5 0.5 0.5 1", "a": "0.82 0.29 0.36 1", "b": "0.18 0.55 0.34 1", "c": "0.18 0.44 0.70 1"}
Vector = tuple[float, float]


def document(name: str, geometry: Geometry, limits: Limits) -> str:
    """Return the URDF document of a robot, with its links, its joints and the limits of the joints [m, rad]."""
    robot = ET.Element("robot", name=name)
    for colour, rgba in COLOURS.items():
        ET.SubElement(ET.SubElement(robot, "material", name=colour), "color", rgba=rgba)
    base = ET.SubElement(robot, "link", name=BASE)
    for leg, side, travel, velocity in zip(
        geometry.each, "abc", limits.slider.positions, limits.slider.velocities, strict=True
    ):
        _draw_rail(base, leg, travel)
        _add_leg(robot, leg, side, travel, velocity, limits)
    platform = ET.SubElement(robot, "link", name=PLATFORM)
    _draw(
        platform, "cylinder", {"radius": f"{geometry.arm / 6:.6g}", "length": f"{PLATFORM_M}"}, (0.0, 0.0), 0.0, "rail"
    )
    ET.indent(robot)
    return '<?xml version="1.0"?>\n' + ET.tostring(robot, encoding="unicode") + "\n"


def _add_leg(robot: ET.Element, leg: AnyLeg, side: str, travel: Vector, velocity: float, limits: Limits) -> None:
    """Add the three joints of a leg: first the slider, then pivot and cross slide in the order of the mechanism."""
    cross = leg.crossing
    start = leg.anchor[0] + leg.home * math.cos(leg.rail_angle), leg.anchor[1] + leg.home * math.sin(leg.rail_angle)
    carriage, turned, slid = f"carriage_{side}", f"pivot_link_{side}", f"cross_link_{side}"
    _add_joint(robot, f"slider_{side}", "prismatic", (BASE, carriage), start, leg.rail_angle, (*travel, velocity))
    _draw(_add_link(robot, carriage), "box", _box(CARRIAGE_M, CARRIAGE_M, CARRIAGE_M), (0.0, 0.0), 0.0, side)
    angles = (*limits.platform.phi, limits.platform.velocity[2])
    passive = (*limits.slider.passive, max(limits.slider.velocities))
    (u, v), angle = cross.point, cross.angle
    if cross.turns:  # the pivot is on the carriage, the cross slide along an edge of the platform
        _add_joint(robot, f"pivot_{side}", "revolute", (carriage, turned), (0.0, 0.0), -leg.rail_angle, angles)
        _add_joint(robot, f"cross_{side}", "prismatic", (turned, slid), (0.0, 0.0), angle, passive)
        end, direction = slid, -angle
        offset = -math.cos(angle) * u - math.sin(angle) * v, math.sin(angle) * u - math.cos(angle) * v
    else:  # the cross slide is on the carriage, the pivot on the platform
        _add_joint(robot, f"cross_{side}", "prismatic", (carriage, slid), (0.0, 0.0), angle - leg.rail_angle, passive)
        _add_joint(robot, f"pivot_{side}", "revolute", (slid, turned), (0.0, 0.0), -angle, angles)
        end, direction, offset = turned, 0.0, (-u, -v)
    _add_link(robot, turned)
    low, high = limits.slider.passive
    _draw(_add_link(robot, slid), "box", _box(high - low, SLIDE_M, SLIDE_M), (-(low + high) / 2.0, 0.0), 0.0, side)
    # Each leg ends at the platform's centre, but only leg A is connected to the platform.
    target = PLATFORM if side == "a" else f"centre_{side}"
    if target != PLATFORM:
        _add_link(robot, target)
    _add_joint(robot, f"end_{side}", "fixed", (end, target), offset, direction)


def _add_link(robot: ET.Element, name: str) -> ET.Element:
    return ET.SubElement(robot, "link", name=name)


def _add_joint(
    robot: ET.Element,
    name: str,
    kind: str,
    links: tuple[str, str],
    xy: Vector,
    angle: float,
    limit: tuple[float, float, float] | None = None,
) -> None:
    """Add a joint between two links, given its position and its direction in the frame of the first link.

    `limit` contains the lower position limit, the upper position limit and the velocity limit.
    """
    joint = ET.SubElement(robot, "joint", name=name, type=kind)
    ET.SubElement(joint, "parent", link=links[0])
    ET.SubElement(joint, "child", link=links[1])
    ET.SubElement(joint, "origin", xyz=f"{xy[0]!r} {xy[1]!r} 0", rpy=f"0 0 {angle!r}")
    if limit is not None:
        ET.SubElement(joint, "axis", xyz="0 0 1" if kind == "revolute" else "1 0 0")
        low, high, velocity = (repr(float(value)) for value in limit)
        ET.SubElement(joint, "limit", lower=low, upper=high, velocity=velocity, effort="0")


def _draw_rail(base: ET.Element, leg: AnyLeg, travel: Vector) -> None:
    low, high = travel
    middle = leg.home + (low + high) / 2.0
    place = leg.anchor[0] + middle * math.cos(leg.rail_angle), leg.anchor[1] + middle * math.sin(leg.rail_angle)
    _draw(base, "box", _box(high - low + CARRIAGE_M, RAIL_M, RAIL_M), place, leg.rail_angle, "rail")


def _box(x: float, y: float, z: float) -> dict[str, str]:
    return {"size": f"{x:.6g} {y:.6g} {z:.6g}"}


def _draw(link: ET.Element, shape: str, size: dict[str, str], xy: Vector, angle: float, colour: str) -> None:
    visual = ET.SubElement(link, "visual")
    ET.SubElement(visual, "origin", xyz=f"{xy[0]:.9g} {xy[1]:.9g} 0", rpy=f"0 0 {angle:.9g}")
    ET.SubElement(ET.SubElement(visual, "geometry"), shape, size)
    ET.SubElement(visual, "material", name=colour)
