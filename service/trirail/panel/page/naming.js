// Named poses: gone to by a press, taught where the robot stands, forgotten; what would be lost is asked about first.

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
    this.question = null; // what is asked, of which name, and since when
    byId("pose-name").addEventListener("input", () => {
      this.#withdraw();
      allow();
    });
    byId("teaching").addEventListener("submit", (event) => {
      event.preventDefault();
      this.#do("teach", this.taught.includes(this.name));
    });
    byId("forget").addEventListener("click", () => this.#do("forget", true));
    onLanguage(() => this.#withdraw());
  }

  get name() {
    return byId("pose-name").value.trim();
  }

  // A pose keeps its place while the page is open, so that no other one comes under a finger.
  poses({ names, taught }) {
    this.names = names;
    this.taught = taught;
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
    button.dataset.pose = button.textContent = name;
    button.addEventListener("click", () => {
      this.answer(say("do.named", { name }));
      this.send({ do: "goal", goal: { kind: "named", name, speed: this.speed() } });
    });
    return button;
  }

  #do(what, loses) {
    const { name, question } = this;
    if (!name) return byId("pose-name").focus();
    const now = performance.now();
    if (loses && question?.what === what && now - question.since < DOUBLE) return;
    if (loses && question?.what !== what) {
      this.#withdraw();
      this.question = { what, since: now, timer: setTimeout(() => this.#withdraw(), ASKED) };
      this.#show();
      return this.ask(say(`ask.${what}`, { name }));
    }
    this.#withdraw();
    this.answer(`${say(`do.${what}`)} ${name}`);
    this.send({ do: what, name });
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
  }
}
