// Named poses: gone to by a press, taught where the robot stands, forgotten. A question comes first where something would be
// lost, and where a pose was taught with another geometry.

import { onLanguage, say } from "./words.js";

const ASKED = 10_000; // for so long a question waits for its answer [ms]
const DOUBLE = 500; // a press so soon after the first is its double click, and no answer [ms]

const byId = (id) => document.getElementById(id);

export class Naming {
  // `speed()` is the share of full speed to go at; `ask(words)` shows a question.
  constructor(send, allow, answer, speed, ask) {
    this.send = send;
    this.allow = allow;
    this.answer = answer;
    this.speed = speed;
    this.ask = ask;
    this.names = [];
    this.taught = [];
    this.foreign = []; // names of the poses that were taught with another geometry
    this.question = null; // what is asked, of which name, and since when
    byId("pose-name").addEventListener("input", () => {
      this.#withdraw();
      allow();
    });
    byId("teaching").addEventListener("submit", (event) => {
      event.preventDefault();
      this.#named("teach", this.taught.includes(this.name));
    });
    byId("forget").addEventListener("click", () => this.#named("forget", true));
    onLanguage(() => this.#withdraw());
  }

  get name() {
    return byId("pose-name").value.trim();
  }

  // A pose keeps its place while the page is open, so that no other one comes under a finger.
  poses({ names, taught, foreign }) {
    Object.assign(this, { names, taught, foreign });
    const places = [...byId("poses").children].map((each) => (names.includes(each.dataset.pose) ? each.dataset.pose : ""));
    for (const name of names.filter((each) => !places.includes(each))) {
      const free = places.indexOf("");
      places[free < 0 ? places.length : free] = name;
    }
    while (places.at(-1) === "") places.pop();
    byId("poses").replaceChildren(...places.map((name) => (name ? this.#button(name) : document.createElement("span"))));
    this.#withdraw();
    this.allow();
  }

  #button(name) {
    const button = document.createElement("button");
    button.type = "button"; // of a form, but not what sends it
    button.translate = false;
    button.dataset.pose = name;
    const foreign = this.foreign.includes(name);
    if (foreign) button.dataset.sayTitle = "poses.foreign";
    button.addEventListener("click", () => {
      if (foreign && !this.#sure("named", name)) return;
      this.#withdraw();
      this.answer(say("do.named", { name }));
      this.send({ do: "goal", goal: { kind: "named", name, speed: this.speed() } });
    });
    return button;
  }

  #named(what, loses) {
    const { name } = this;
    if (!name) return byId("pose-name").focus();
    if (loses && !this.#sure(what, name)) return;
    this.#withdraw();
    this.answer(`${say(`do.${what}`)} ${name}`);
    this.send({ do: what, name });
  }

  // Whether the press answers the question; if the question is not open, ask it.
  #sure(what, name) {
    const { question } = this;
    const now = performance.now();
    if (question?.what === what && question.name === name) {
      if (now - question.since < DOUBLE) return false;
      this.#withdraw();
      return true;
    }
    this.#withdraw();
    this.question = { what, name, since: now, timer: setTimeout(() => this.#withdraw(), ASKED) };
    this.#show();
    this.ask(say(`ask.${what}`, { name }));
    return false;
  }

  #withdraw() {
    if (this.question) this.ask("");
    clearTimeout(this.question?.timer);
    this.question = null;
    this.#show();
  }

  #show() {
    for (const what of ["teach", "forget"]) {
      const asked = this.question?.what === what;
      byId(what).classList.toggle("asked", asked);
      byId(what).textContent = say(asked ? "ask.again" : `do.${what}`);
    }
    for (const button of document.querySelectorAll("#poses button")) {
      const name = button.dataset.pose;
      const asked = this.question?.what === "named" && this.question.name === name;
      button.classList.toggle("asked", asked);
      button.textContent = asked ? say("ask.again") : this.foreign.includes(name) ? `⚠ ${name}` : name;
    }
  }
}
