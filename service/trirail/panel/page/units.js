// Lengths and angles in the unit and with the decimals that the robot's size asks for.

import { number } from "./words.js";

export const DEGREE = Math.PI / 180;

const MORE = 9; // so many decimals are added at most

let resolution = { unit: "mm", scale: 1e3, decimals: 2, angle_decimals: 3 };

export function useResolution(found) {
  resolution = found;
}

export const unit = () => resolution.unit;

// Numbers as they are typed into a field: of a length [m] in the unit, of an angle [rad] in degrees.
export const typedLength = (metres) => number(metres * resolution.scale, 0, resolution.decimals + 2).replace("−", "-");

export const typedAngle = (radians) => number(radians / DEGREE, 0, resolution.angle_decimals + 1).replace("−", "-");

export const length = (metres, decimals = resolution.decimals) => `${number(metres * resolution.scale, decimals)} ${resolution.unit}`;

export const velocity = (metresPerSecond) => `${number(metresPerSecond * resolution.scale, resolution.decimals - 1)} ${resolution.unit}/s`;

export const angle = (radians, decimals = resolution.angle_decimals) => `${number(radians / DEGREE, decimals)}°`;

// A value with three digits, as of speeds.
export const rounded = (value, digits = 3) => number(Number(value.toPrecision(digits)), 0, 12);

// A value and its limit, `unit` "m", "rad" or another: with so many decimals that they differ where the values do.
export function apart(value, limit, unit) {
  const shown = (each, more) =>
    unit === "m" ? length(each, resolution.decimals + more) : unit === "rad" ? angle(each, resolution.angle_decimals + more) : `${rounded(each, 3 + more)} ${unit}`;
  let more = 0;
  while (more < MORE && value !== limit && shown(value, more) === shown(limit, more)) more++;
  return [shown(value, more), shown(limit, more)];
}

// A jog step [m] in the unit that keeps it short.
export function step(metres) {
  return metres < 0.99e-4 ? `${number(metres * 1e6, 0, 1)}\u00a0µm` : `${number(metres * 1e3, 0, 3)}\u00a0mm`; // on one line
}
