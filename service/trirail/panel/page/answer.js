// The line that says what has become of what was pressed: only for as long as it is so.

import { onLanguage, say } from "./words.js";

const SHOWN = { done: 8000, refused: 15000 }; // how long a line stays at most [ms]
const SETTLES = 300; // a command whose state is not known is taken to be shown after so long [ms]
const LATE = 3000; // a goal whose end is not told has ended if the robot has had no goal for so long [ms]
const KEPT = 50; // so many ended goals are remembered: an end may be told before the goal is known to be this page's
const MOTION = ["holding", "moving", "stopping"];

export class Answer {
  constructor(element) {
    this.element = element;
    this.line = null;
    this.ended = new Map();
    onLanguage(() => this.clear());
  }

  clear() {
    this.line = null;
    this.#show("");
  }

  // It has been asked for, and is not answered yet.
  asked(what) {
    this.line = { kind: "asked" };
    this.#show(say("answer.asked", { what }));
  }

  // A goal has been accepted: it is under way, waits, or has ended already.
  accepted(what, id) {
    this.line = { kind: "goal", what, id };
    if (this.ended.has(id)) this.#goalEnded(this.ended.get(id));
    else this.#show(say("answer.accepted", { what }));
  }

  // A command has been carried out; `seq` is that of the first state which shows it, 0 where that is not known, and
  // `holds(state)` whether it is still so.
  done(what, seq, holds = () => true) {
    this.#passing("done", seq, holds);
    this.#show(say("answer.done", { what }));
  }

  // Words that stay while the robot does the same, with what the service says.
  refused(words, said = null) {
    this.#passing("refused", 0);
    this.#show(words, said);
  }

  event(event) {
    if (event.kind !== "goal") return;
    this.ended.set(event.id, event);
    if (this.ended.size > KEPT) this.ended.delete(this.ended.keys().next().value);
    if (this.line?.kind === "goal" && this.line.id === event.id) this.#goalEnded(event);
  }

  state(state) {
    const { line } = this;
    if (line?.kind === "goal") {
      line.idle = state.goal ? null : (line.idle ?? performance.now());
      if (!state.goal && performance.now() - line.idle > LATE) return this.clear();
      const begun = state.goal?.id === line.id;
      const waits = !begun || state.mode === "holding" || state.override === 0;
      this.#show(say(waits ? "answer.waits" : "answer.accepted", { what: line.what }));
    } else if (line?.kind === "done" || line?.kind === "refused") {
      const { mode, lease, override, faults } = state;
      // A refusal stays while the robot comes to rest after it.
      const shownMode = line.kind === "refused" && MOTION.includes(mode) ? "" : mode;
      const situation = JSON.stringify([shownMode, lease, override, faults]);
      const now = performance.now();
      if (line.seq ? state.seq >= line.seq : now > line.since + SETTLES) line.situation ??= situation;
      if (now > line.since + SHOWN[line.kind] || (line.situation && (line.situation !== situation || !line.holds(state)))) this.clear();
    }
  }

  #goalEnded({ outcome, cycle }) {
    const { what } = this.line;
    this.#passing(outcome === "done" ? "done" : "refused", cycle + 1);
    this.#show(say("answer.ended", { what, end: say(`outcome.${outcome}`) }));
  }

  #passing(kind, seq, holds = () => true) {
    this.line = { kind, seq, holds, since: performance.now(), situation: null };
  }

  #show(words, said = null) {
    const refused = this.line?.kind === "refused";
    this.element.classList.toggle("refused", refused);
    const same = !said && this.element.childNodes.length === 1 && this.element.textContent === words;
    if (!same) this.element.replaceChildren(words, ...(said ? [words && " ", said] : []));
  }
}
