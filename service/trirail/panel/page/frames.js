// Poses, x, y [m] and φ [rad], of tools of the platform and in frames, as the service has them.

import { withhold } from "./focus.js";

export const NO_TOOL = [0, 0];
export const BASE = [0, 0, 0];

export function rotated([x, y], angle) {
  const [c, s] = [Math.cos(angle), Math.sin(angle)];
  return [c * x - s * y, s * x + c * y];
}

// The pose of a point (u, v) of the platform, from its centre's.
export function ofTool([x, y, phi], tool) {
  const [u, v] = rotated(tool, phi);
  return [x + u, y + v, phi];
}

export function ofCentre(pose, [u, v]) {
  return ofTool(pose, [-u, -v]);
}

// A pose in a frame, from the base's.
export function inFrame([x, y, phi], [fx, fy, angle]) {
  return [...rotated([x - fx, y - fy], -angle), phi - angle];
}

export function inBase([x, y, phi], [fx, fy, angle]) {
  const [u, v] = rotated([x, y], angle);
  return [fx + u, fy + v, phi + angle];
}

// Offer names in a <select>, and keep what is chosen where it is still there; hidden where there is nothing to choose.
export function offer(select, entries) {
  const chosen = select.value;
  const focused = select.contains(document.activeElement); // it may be on an option, which is replaced
  select.replaceChildren(...entries.map(([value, name]) => new Option(name, value, false, value === chosen)));
  if (focused) select.focus({ preventScroll: true });
  withhold(select.closest("label"), "hidden", entries.length < 2);
}
