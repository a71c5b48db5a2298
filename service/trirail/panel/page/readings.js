// What the robot says in words and numbers: mode, faults, pose, sliders, events, and answers to what was pressed.

import { quoted, say } from "./words.js";

const KEPT = 200; // so many events are shown
const byId = (id) => document.getElementById(id);

export class Readings {
  constructor() {
    this.colours = {};
    this.pose = rows(byId("pose"), ["x", "y", "φ"], 2);
    this.sliders = rows(byId("sliders"), ["A", "B", "C"], 2);
    this.rank = [0, 0];
    this.decimals = 2;  // of mm; of degrees one more
  }

  waits() {
    text(byId("mode-name"), say("connecting"));
  }

  robot({ name, user, role, version, colours, sliders, decimals }) {
    this.decimals = decimals;
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

  state({ mode, pose, goal, sliders, faults, override }) {
    const doing = [];
    const waits = mode === "holding" || override === 0;  // half-way, paused or at override 0
    if (goal?.lag != null) doing.push(say("doing.track", { lag: (goal.lag * 1000).toFixed(1) }));
    else if (goal?.target) {
      const key = waits && goal.progress < 1 ? "doing.waits" : "doing.goal";
      doing.push(say(key, { id: goal.id, percent: Math.round(goal.progress * 100), left: goal.remaining.toFixed(1) }));
    } else if (goal) doing.push(say("doing.jog"));
    if (override !== 1) doing.push(say("doing.override", { percent: Math.round(override * 100) }));
    text(byId("mode-name"), say(`mode.${mode}`, {}, mode));
    text(byId("doing"), doing.join(" · "));
    byId("lamp").style.background = this.colours[mode] ?? "transparent";
    this.alarm(...(faults.length ? [say("fault"), faults.join("\n"), say("fault.remedy")] : []));
    const shown = (value, k) => (k < 2 ? `${fixed(value * 1e3, this.decimals)} mm` : `${fixed((value * 180) / Math.PI, this.decimals + 1)}°`);
    this.pose.forEach(([measured, target], k) => {
      text(measured, shown(pose[k], k));
      text(target, goal?.target ? shown(goal.target[k], k) : "–");
    });
    this.sliders.forEach(([position, velocity], k) => {
      text(position, `${fixed(sliders.position[k] * 1e3, this.decimals)} mm`);
      text(velocity, `${fixed(sliders.velocity[k] * 1e3, this.decimals - 1)} mm/s`);
    });
  }

  lost(why) {
    text(byId("mode-name"), say("no_contact"));
    text(byId("doing"), "");
    byId("lamp").style.background = "transparent";
    for (const cell of [...this.pose, ...this.sliders].flat()) text(cell, "–");
    this.alarm(why);
  }

  // The page's words, what the robot says, and the page's again.
  alarm(words = "", said = "", remedy = "") {
    const whole = words + said + remedy;
    byId("alarm").hidden = !whole;
    if (whole === this.alarmed) return; // the same words again are not said again
    this.alarmed = whole;
    byId("alarm").replaceChildren(words, " ", quoted(said), "\n", remedy);
  }

  event({ seq, time, level, message, outcome }) {
    if (seq <= this.rank[0] && time <= this.rank[1]) return; // told again, on a new connection
    this.rank = [seq, time];
    const item = document.createElement("li");
    const at = document.createElement("time");
    at.textContent = new Date(time * 1e3).toLocaleTimeString("en-GB");
    item.className = level;
    if (outcome) item.dataset.outcome = outcome;
    item.append(at, message);
    byId("events").prepend(item);
    while (byId("events").childElementCount > KEPT) byId("events").lastChild.remove();
  }

  // The page's words, and what the service says.
  answer(words, refused = false, said = "") {
    byId("answer").classList.toggle("refused", refused);
    byId("answer").replaceChildren(words, ...(said ? [words && " ", quoted(said)] : []));
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

function text(element, words) {
  if (element.textContent !== words) element.textContent = words;
}

function fixed(value, digits) {
  return (Number(value.toFixed(digits)) + 0).toFixed(digits).replace("-", "−");
}
