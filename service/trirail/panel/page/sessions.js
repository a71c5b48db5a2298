// The recorded sessions: when, whose goals ended how, faults; a report of each, and its files to download.

import { date, onLanguage, quoted, say } from "./words.js";

const HEADS = ["began", "lasted", "goals", "faults", "files"];
const byId = (id) => document.getElementById(id);

export class Sessions {
  constructor() {
    this.told = null;
    onLanguage(() => this.#show());
  }

  // Ask anew what there is.
  async ask() {
    try {
      this.told = await (await fetch("sessions")).json();
    } catch (error) {
      this.told = { folder: "", trouble: String(error) };
    }
    this.#show();
  }

  #show() {
    if (this.told === null) return byId("sessions").replaceChildren();
    const { folder, here, sessions, trouble } = this.told;
    if (trouble) return byId("sessions").replaceChildren(say("sessions.trouble", { folder }), " ", quoted(trouble));
    if (!here || !sessions.length)
      return byId("sessions").replaceChildren(say(here ? "sessions.none" : "sessions.elsewhere"), " ", quoted(folder));
    const table = document.createElement("table");
    const head = table.createTHead().insertRow();
    for (const name of HEADS) head.append(cell("th", say(`sessions.${name}`)));
    const body = table.createTBody();
    for (const each of sessions) row(body.insertRow(), each);
    byId("sessions").replaceChildren(table);
  }
}

function row(made, { session, began, duration, goals, faults, files, reason, trouble, running, lost_cycles: lost }) {
  const counts = Object.entries(goals).map(([outcome, times]) => `${times} ${outcome}`).join(", ");
  const wrong = [trouble ?? reason ?? faults[0] ?? "", !reason && faults.length > 1 ? ` (+${faults.length - 1})` : ""].join("");
  made.append(
    cell("td", quoted(began === null ? "–" : date(began))),
    cell("td", quoted(began === null ? "–" : lasted(duration)), running ? ` ${say("sessions.running")}` : ""),
    cell("td", quoted(counts || "–")),
    cell("td", reason && !trouble ? `${say("sessions.black_box")} ` : "", quoted(wrong || "–"), lost ? ` ${say("sessions.lost", { lost })}` : ""),
    cell("td", link(say("sessions.report"), `report/${encodeURIComponent(session)}`), ...files.flatMap((name) => [" ", saved(name)])),
  );
}

function cell(kind, ...content) {
  const made = document.createElement(kind);
  made.append(...content);
  return made;
}

function link(words, to) {
  const made = document.createElement("a");
  made.textContent = words;
  made.href = to;
  made.target = "_blank";
  made.rel = "noopener";
  return made;
}

function saved(name) {
  const made = link(name, `recording/${encodeURIComponent(name)}`);
  made.removeAttribute("target");
  made.download = name;
  made.translate = false;
  return made;
}

function lasted(seconds) {
  const [hours, minutes, rest] = [seconds / 3600, (seconds / 60) % 60, seconds % 60].map(Math.floor);
  return `${hours}:${String(minutes).padStart(2, "0")}:${String(rest).padStart(2, "0")}`;
}
