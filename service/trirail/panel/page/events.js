// The events, newest first: one line for each goal, which is under way, then has ended.

import { event as worded } from "./service_words.js";
import { onLanguage, time } from "./words.js";

const KEPT = 200; // so many lines are shown

export class Events {
  constructor(list) {
    this.list = list;
    this.newest = new Map(); // the number of the newest event, of each run of the service
    this.mode = "";
    this.goalEnded = -1; // in which cycle
    this.faults = new Map(); // the events of faults, by their messages
    onLanguage(() => {
      for (const item of list.children) fill(item);
    });
  }

  // Show an event; return false for one that is told again, on a new connection.
  add(event) {
    const { seq, run = "", kind, message } = event;
    if (seq <= this.newest.get(run)) return false;
    this.newest.set(run, seq);
    if (kind === "fault") this.faults.set(message, event);
    if (this.#isPartOfGoal(event)) return true;
    const goal = kind === "goal" ? event.id : kind === "mode" ? event.goal : undefined;
    // An id may be used again by a later goal: the end of the earlier one stays.
    if (goal) [...this.list.children].find((each) => each.dataset.goal === goal && !each.dataset.outcome)?.remove();
    const item = document.createElement("li");
    if (goal) item.dataset.goal = goal;
    item.event = event;
    fill(item);
    this.list.prepend(item);
    while (this.list.childElementCount > KEPT) this.list.lastChild.remove();
    return true;
  }

  // Whether a mode follows from a goal's end, which has its line.
  #isPartOfGoal({ kind, mode, cycle }) {
    if (kind === "goal") this.goalEnded = cycle;
    if (kind !== "mode") return false;
    const before = this.mode;
    this.mode = mode;
    return (mode === "holding" && (before === "moving" || before === "stopping")) || (mode === "stopping" && cycle === this.goalEnded);
  }
}

function fill(item) {
  const { time: seconds, level, outcome } = item.event;
  item.className = level;
  if (outcome) item.dataset.outcome = outcome;
  const at = document.createElement("time");
  at.textContent = time(seconds);
  item.replaceChildren(at, worded(item.event));
}
