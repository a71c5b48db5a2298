// What the service says, in the language of the page: by its codes, with their values. The service's own sentence,
// which is English, stands where the language has no words for a code, and is shown on hover where it has.

import { angle, apart, length } from "./units.js";
import { has, number, quoted, say } from "./words.js";

const SLIDERS = ["A", "B", "C"]; // as the service names them in refusals
let labels = SLIDERS; // as this robot names them

export function useLabels(sliders) {
  labels = sliders;
}

// A refusal, or how a jog ended: {code, message, slider, value, limit}.
export function refusal(told) {
  return worded(`refusal.${told.code}`, { ...told, bound: bound(told) }, told.message);
}

// What is in the way of a pose: {message, code, what, value, limit, unit}.
export function obstacle(told) {
  const [value, limit] = apart(told.value ?? 0, told.limit ?? 0, told.unit || "rad");
  return worded(`obstacle.${told.code}`, { what: told.what, value, limit }, told.message);
}

// A reason why the robot is in fault, with the event that told it, if one did.
export function fault(message, told) {
  return told ? event(told) : quoted(message);
}

export function event(told) {
  const { kind, message, id, outcome, user, mode, code } = told;
  const why = code ? refusal(told).textContent : sentence(told);
  if (kind === "refused" && code) return worded("event.refused", { user, why }, message);
  if (kind === "goal") return worded(why ? "event.goal_because" : "event.goal", { id, user, end: say(`outcome.${outcome}`), why }, message);
  if (kind === "mode" && !told.goal) return worded(why ? "event.mode_because" : "event.mode", { mode: say(`mode.${mode}`), why }, message);
  return why ? spoken(why, message) : quoted(message);
}

// How values of events are shown, by their names; others as numbers, or as they are.
const metres = (value) => length(value);
const seconds = (value) => `${number(value, 0, 3)} s`;
const limited = ({ value, limit = value, unit = "m" }) => apart(value ?? limit, limit, unit);
const word = (value) => say(`word.${value.replaceAll(" ", "_")}`, {}, value);
const alignment = (value) => say(`alignment.${value}`, {}, value);
const SHOWN = {
  command: (value) => say(`do.${value}`, {}, value).replaceAll("\u00ad", ""),
  outcome: (value) => say(`outcome.${value}`, {}, value),
  purpose: alignment,
  end: alignment,
  part: word,
  quantity: word,
  cause,
  x: metres,
  y: metres,
  phi: (value) => angle(value),
  position: metres,
  position_before: metres,
  on: (value) => say(value ? "input.on" : "input.off"),
  value: (_, params) => limited(params)[0],
  limit: (_, params) => limited(params)[1],
  settle: (value) => `${number(value * 1e3, 0, 3)} ms`,
  timeout: seconds,
  silence: seconds,
  seconds,
  wait: seconds,
  duration: seconds,
  until: seconds,
};

// An event's sentence; empty where the language has none for its code.
function sentence({ event_code, params = {}, fault }) {
  if (!event_code && fault && has("cause.drive")) return cause(fault.cause, fault); // of an older service
  if (!has(`said.${event_code}`)) return "";
  const shown = ([name, value]) => [name, SHOWN[name]?.(value, params) ?? (typeof value === "number" ? number(value, 0, 3) : value)];
  return say(`said.${event_code}`, Object.fromEntries(Object.entries(params).map(shown)));
}

// The cause of a fault: {drive, code} tell which drive, and its own error code.
function cause(name, { drive = "", code = 0 }) {
  const where = drive && say("cause.drive", { drive });
  return say(`cause.${name}`, { where, code: code ? code.toString(16).toUpperCase().padStart(4, "0") : "" }, `${where}${name}`);
}

// The slider, its value and its limit; empty where the refusal names none.
function bound({ slider, value, limit, code }) {
  if (code !== "out_of_workspace" || !slider || value == null || limit == null || !has("bound.slider")) return "";
  const [shown, bound] = apart(value, limit, "m");
  return say("bound.slider", { slider: labels[SLIDERS.indexOf(slider)], value: shown, limit: bound });
}

function worded(key, values, message) {
  return has(key) ? spoken(say(key, values), message) : quoted(message);
}

// The page's own words, with the service's sentence on hover.
function spoken(text, message) {
  const span = document.createElement("span");
  span.textContent = text;
  span.title = message;
  return span;
}
