// What the robot says in words and numbers: mode, faults, pose, sliders.

import { fault } from "./service_words.js";
import { angle, length, useResolution, velocity } from "./units.js";
import { number, say } from "./words.js";

const byId = (id) => document.getElementById(id);

export class Readings {
  // `told` has the events of faults, by their messages.
  constructor(told) {
    this.told = told;
    this.colours = {};
    this.pose = rows(byId("pose"), ["x", "y", "φ"], 2);
    this.sliders = rows(byId("sliders"), ["A", "B", "C"], 2);
  }

  waits() {
    text(byId("mode-name"), say("connecting"));
  }

  robot({ name, user, role, version, colours, sliders, resolution }) {
    useResolution(resolution);
    this.colours = colours.modes;
    byId("name").textContent = name;
    byId("user").textContent = say("user", { user, role: say(`role.${role ?? "none"}`), version });
    document.title = `${name} – trirail`;
    this.sliders.forEach((cells, k) => {
      const head = cells[0].parentElement.firstChild;
      head.style.color = colours.sliders[k];
      text(head, sliders[k]);
    });
  }

  state({ mode, pose, goal, sliders, faults, override, warnings }) {
    const doing = [];
    const waits = mode === "holding" || override === 0;  // half-way, paused or at override 0
    if (goal?.lag != null) doing.push(say("doing.track", { lag: length(goal.lag, 1) }));
    else if (goal?.target) {
      const key = waits && goal.progress < 1 ? "doing.waits" : "doing.goal";
      doing.push(say(key, { id: goal.id, percent: number(goal.progress * 100), left: number(goal.remaining, 1) }));
    } else if (goal) doing.push(say("doing.jog"));
    if (override !== 1) doing.push(say("doing.override", { percent: number(override * 100) }));
    text(byId("mode-name"), say(`mode.${mode}`, {}, mode));
    text(byId("doing"), doing.join(" · "));
    byId("lamp").style.background = this.colours[mode] ?? "transparent";
    warn(warnings);
    this.alarm(faults.length ? say("fault") : "", faults, faults.length ? say("fault.remedy") : "");
    const shown = (value, k) => (k < 2 ? length(value) : angle(value));
    const homed = sliders.homed.every(Boolean); // without one position the pose is unknown
    this.pose.forEach(([measured, target], k) => {
      text(measured, homed ? shown(pose[k], k) : say("not_homed"));
      text(target, goal?.target ? shown(goal.target[k], k) : "–");
    });
    this.sliders.forEach(([position, speed], k) => {
      text(position, sliders.homed[k] ? length(sliders.position[k]) : say("not_homed"));
      text(speed, velocity(sliders.velocity[k]));
    });
  }

  lost(why) {
    text(byId("mode-name"), say("no_contact"));
    text(byId("doing"), "");
    byId("lamp").style.background = "transparent";
    for (const cell of [...this.pose, ...this.sliders].flat()) text(cell, "–");
    warn([]);
    this.alarm(why);
  }

  // The page's words, what the robot says, and the page's again.
  alarm(words = "", faults = [], remedy = "") {
    const known = faults.map((each) => [each, this.told.get(each)]);
    const whole = JSON.stringify([words, known, remedy]);
    if (whole === this.alarmed) return; // the same words again are not said again
    this.alarmed = whole;
    byId("alarm").hidden = !words;
    byId("alarm").replaceChildren(words, " ", ...known.flatMap(([each, event]) => [fault(each, event), "\n"]), remedy);
  }
}

function rows(body, names, columns) {
  return names.map((name) => {
    const row = body.insertRow();
    const head = document.createElement("th");
    head.scope = "row";
    head.textContent = name;
    row.append(head);
    return Array.from({ length: columns }, () => row.insertCell());
  });
}

// The warnings in force: the first beside the mode, all of them above the events.
function warn(warnings) {
  const [first = "", ...more] = warnings;
  text(byId("warning"), first && more.length ? `${first} (+${more.length})` : first);
  text(byId("warnings"), warnings.join("\n"));
}

function text(element, words) {
  if (element.textContent !== words) element.textContent = words;
}
